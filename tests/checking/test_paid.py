"""Signs, indices and bonuses that are wrong in the source of the reward."""

import numpy as np
import pytest

from rlctl.checking.paid_commands import CommandReader
from rlctl.checking.paid_errors import ErrorReader
from rlctl.checking.paid_goals import GoalReader
from rlctl.checking.paid_successes import SuccessReader
from tests.checking.judging import case, check_case, mark_slow, notes_of

pytest.importorskip("mujoco")
FILE = "broken_paid.py"


def broken(name, twin):
    return case(f"{FILE}:{name}", (name[:5], "warning"), twin=f"{FILE}:{twin}", slow=True)


CASES = [
    broken("RL634SkidRaces", "Skid"),
    broken("RL630SkidSavesInReverse", "Skid"),
    broken("RL632SkidTurnsAsItDrives", "Skid"),
    broken("RL635SkidRolls", "Skid"),
    broken("RL622DockerFlees", "Docker"),
    broken("RL622DockerIsNearAtACost", "Docker"),
    broken("RL620DockerComparesWithItself", "Docker"),
    broken("RL605DockerWaits", "Docker"),
    broken("RL605DockerHooksForever", "DockerHooks"),
    broken("RL640RoverIsUpright", "RoverIsSlow"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def note(name):
    with notes_of(f"{FILE}:{name}") as notes:
        return notes


def test_the_summands_of_a_weighted_loop_have_names_and_weights():
    summands = note("Skid").reward.summands
    assert [(one.name, one.weight) for one in summands] == [
        ("0.0", 1.0),
        ("track_speed", 1.0),
        ("track_speed", -1.0),
        ("track_turn", 0.5),
        ("drive", -0.02),
    ]


def test_the_summands_of_a_step_add_up_to_its_reward():
    notes = note("Docker")
    paid = [one for one in notes.reward.summands if not one.conditions]
    parts = [one.weight * notes.reward.numbers.list_values(one.place.node) for one in paid]
    steps = len(notes.steps)
    total = sum(np.broadcast_to(part, steps) for part in parts)
    noted = [(one.text, notes.reward.numbers.list_values(one.node)) for one in notes.source.expressions]
    by_text = {text: values for text, values in noted if values.size}
    assert np.allclose(total + 10 * by_text["bool(gap < 0.1)"], by_text["float(reward)"])


@pytest.mark.parametrize(
    ("name", "find"),
    [
        ("RL634SkidRaces", lambda notes: ErrorReader(notes).find_errors()),
        ("RL630SkidSavesInReverse", lambda notes: ErrorReader(notes).find_sums()),
        ("RL632SkidTurnsAsItDrives", lambda notes: CommandReader(notes).find_unpaid()),
        ("RL635SkidRolls", lambda notes: CommandReader(notes).find_other_axes()),
        ("RL622DockerFlees", lambda notes: GoalReader(notes).find_wrong_signs()),
        ("RL622DockerIsNearAtACost", lambda notes: GoalReader(notes).find_wrong_signs()),
    ],
)
def test_the_source_alone_shows_the_mistake(name, find):
    assert list(find(note(name)))
    assert not list(find(note("Docker" if "Docker" in name else "Skid")))


def test_what_success_pays_is_less_than_the_steps_next_to_it():
    waits, sound = GoalReader(note("RL605DockerWaits")), GoalReader(note("Docker"))
    assert waits.ends_at_success()
    assert sound.ends_at_success()
    assert (waits.read_bonus(), sound.read_bonus()) == (10.0, 10.0)
    assert waits.read_income() == pytest.approx(0.52)
    assert sound.read_income() == pytest.approx(-0.03)


@pytest.mark.slow
def test_what_is_paid_for_a_flag_is_earned_next_to_the_goal_and_for_a_change_it_is_not():
    with notes_of(f"{FILE}:RL605DockerHooksForever") as notes:
        staying, docking = SuccessReader(notes).read_incomes()
    assert 0.25 < staying <= 0.4
    assert docking == pytest.approx(2.4, abs=0.1)
    with notes_of(f"{FILE}:DockerOpensItsHook") as notes:
        assert SuccessReader(notes).read_incomes()[0] <= 0
