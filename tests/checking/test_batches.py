"""What goes wrong only when a task in batches has several worlds."""

import numpy as np
import pytest

from rlctl.checking.rules.rl406_worlds_affect_each_other import describe_difference
from tests.checking.judging import case, check_case, findings, found, mark_slow

pytest.importorskip("mujoco")

FILE = "broken_batches.py"
SOUND = f"{FILE}:Point"
CASES = [
    case(f"{FILE}:RL406ScalesByAll", ("RL406", "error"), twin=f"{FILE}:RL406ScalesByEach", slow=True),
    case(f"{FILE}:RL406SharesNoise", ("RL406", "error"), twin=SOUND),
    case(
        f"{FILE}:RL407ResetsAllGoals",
        ("RL407", "error"),
        ("RL406", "error"),
        twin=f"{FILE}:RL407ResetsItsGoal",
        slow=True,
    ),
    case(f"{FILE}:RL407MovesAllBases", ("RL407", "error"), ("RL406", "warning"), twin=f"{FILE}:RL407MovesItsBase"),
    case(f"{FILE}:RL408OneRow", ("RL408", "error"), twin=SOUND, slow=True),
    case(f"{FILE}:RL408OneGoal", ("RL408", "error"), twin=SOUND),
    case(f"{FILE}:RL409CountsSteps", ("RL409", "error"), twin=f"{FILE}:RL409CountsStepsOfEach", slow=True),
    case(f"{FILE}:RL409KeepsLast", ("RL409", "error"), twin=SOUND),
    case(f"{FILE}:RL409Logs", ("RL409", "warning"), twin=SOUND),
]
CLEAN = [
    SOUND,
    f"{FILE}:RL406ScalesByEach",
    f"{FILE}:RL407ResetsItsGoal",
    f"{FILE}:RL407MovesItsBase",
    f"{FILE}:RL409CountsStepsOfEach",
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow_except(
    "broken_batches.py:Point", "broken_batches.py:RL406ScalesByEach", "broken_batches.py:RL409CountsStepsOfEach"
)
@pytest.mark.parametrize("task", ["walk", *CLEAN])
def test_a_sound_task_has_no_finding_of_batches(task):
    assert found(task, "RL406", "RL407", "RL408", "RL409") == set()


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("name", "rule", "message"),
    [
        (
            "RL406ScalesByAll",
            "RL406",
            "the episode of a world differs with other seeds and actions in the other worlds: at",
        ),
        ("RL406SharesNoise", "RL406", "the episode of a world differs with one world alone: at reset goal is"),
        ("RL407ResetsAllGoals", "RL407", "the reset of world 2 of 4 changes in the others: self.goal"),
        ("RL407MovesAllBases", "RL407", "the reset of world 2 of 4 changes in the others: base_position of 'cart'"),
        (
            "RL408OneRow",
            "RL408",
            "step with 4 worlds raises ShapeError: RL408OneRow: rewards()['change'] is an array of float64 of shape "
            "(1,), expected numbers of shape (4,): a row per world",
        ),
        (
            "RL408OneGoal",
            "RL408",
            "step with 4 worlds raises ValueError: cannot reshape array of size 2 into shape (4,2)",
        ),
        (
            "RL409CountsSteps",
            "RL409",
            "self.steps changes from step to step, changes what later steps give, and is not in per_world",
        ),
        ("RL409KeepsLast", "RL409", "self.last_action changes from step to step, changes what later steps give"),
        ("RL409Logs", "RL409", "self.mean_error changes from step to step, is the same for all worlds, and is not in"),
    ],
)
def test_the_message_names_what_is_wrong(name, rule, message):
    (finding,) = findings(f"{FILE}:{name}", rule)
    assert finding.message.startswith(message)


def test_kept_values_are_not_judged_where_the_seed_does_not_determine_an_episode():
    from tests.checking.judging import verdict_of

    verdict = verdict_of(f"{FILE}:CachesAndForgetsTheSeed", "RL409")
    assert "differs from its repetition" in verdict.not_judged["RL409"]


def test_a_difference_by_rounding_is_named():
    assert describe_difference(0.5, 0.25) == "is 0.5, then 0.25"
    rounded = describe_difference(0.5, float(np.nextafter(0.5, 1.0)))
    assert rounded.startswith("is 0.5, then 1.1e-16 more: a @ b rounds")


def test_any_other_environment_has_no_worlds():
    from tests.checking.judging import verdict_of

    assert verdict_of("broken_envs.py:Clean", "RL406").not_applicable == {
        "RL406": "it is no BatchTask, whose worlds are simulated together"
    }
