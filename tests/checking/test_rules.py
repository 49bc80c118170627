"""Each rule finds its mistake, and only that; `Clean` and its like come out clean.

Lives the environments in this process; what needs a process of its own is in `test_processes.py`.
"""

import re
from importlib import import_module

import pytest

from rlctl.checking.rules import RULES
from rlctl.checking.values import find_numbers
from tests.checking.judging import (
    FOLDER,
    IN_PROCESSES,
    case,
    check_case,
    findings,
    found,
    mark_slow,
    records_of,
    verdict_of,
)

CASES = [
    case("broken_envs.py:OldGym", ("RL003", "error"), ("RL201", "error"), ("RL202", "error")),
    case("broken_envs.py:WrongShape", ("RL101", "error")),
    case("broken_envs.py:MissingKey", ("RL101", "error")),
    case("broken_envs.py:Float64", ("RL102", "warning")),
    case("broken_envs.py:OutOfRange", ("RL103", "warning")),
    case("broken_envs.py:OutOfRangeAtReset", ("RL103", "error")),
    case("broken_envs.py:OftenOutOfRange", ("RL103", "error")),
    case("broken_envs.py:LastOutOfRange", ("RL103", "info")),
    case("broken_envs.py:Rounding", ("RL103", "warning")),
    case("broken_envs.py:NanObservation", ("RL104", "error")),
    case("broken_envs.py:ReusedMemory", ("RL105", "info")),
    case("broken_envs.py:UnboundedActions", ("RL106", "error")),
    case("broken_envs.py:WideActions", ("RL106", "info")),
    case("broken_spaces.py:OddImage", ("RL108", "warning")),
    case("broken_spaces.py:FloatPicture", ("RL108", "warning"), twin="broken_spaces.py:Tiles"),
    case("broken_spaces.py:TwoAxes", ("RL108", "warning"), twin="broken_spaces.py:FloatTable"),
    case("broken_spaces.py:Dark", ("RL108", "warning"), twin="broken_spaces.py:Seen"),
    case("broken_spaces.py:Asymmetric", ("RL106", "warning")),
    case("broken_spaces.py:Thrust", ("RL106", "info")),
    case("broken_spaces.py:TupleObservation", ("RL109", "warning")),
    case("broken_spaces.py:TextObservation", ("RL109", "warning")),
    case("broken_spaces.py:CountsFromOne", ("RL109", "warning")),
    case("broken_envs.py:FourValues", ("RL201", "error")),
    case("broken_envs.py:NoSeed", ("RL202", "error")),
    case("broken_envs.py:NoOptions", ("RL203", "warning")),
    case("broken_envs.py:NumpyBool", ("RL204", "info")),
    case("broken_envs.py:ArrayReward", ("RL204", "error")),
    case("broken_envs.py:Float32Reward", ("RL204", "info")),
    case("broken_envs.py:NoneInfo", ("RL204", "error")),
    case("broken_envs.py:SuccessIsADistance", ("RL204", "warning")),
    case("broken_envs.py:Raises", ("RL207", "error")),
    case("broken_envs.py:Exits", ("RL207", "error")),
    case("broken_repeats.py:GlobalRandom", ("RL301", "error"), ("RL309", "warning")),
    case("broken_repeats.py:NoisyStep", ("RL302", "error"), ("RL309", "warning")),
    case("broken_repeats.py:LeakyReset", ("RL303", "error")),
    case("broken_repeats.py:ClassCounter", ("RL304", "error")),
    case("broken_repeats.py:FixedStart", ("RL306", "info")),
    case("broken_repeats.py:UnseededLater", ("RL308", "warning")),
    case("broken_repeats.py:OldActionsAsRegistered", ("RL301", "error")),
    case("broken_repeats.py:Residue", ("RL301", "warning")),
    case("broken_repeats.py:SharedWorld", ("RL401", "error"), ("RL402", "error"), ("RL808", "error"), pybullet=True),
    case("broken_repeats.py:CloseBreaks", ("RL402", "error")),
    case("broken_repeats.py:OnlyOne", ("RL403", "error")),
    case("broken_envs.py:TimeLimitTerminates", ("RL501", "warning")),
    case("broken_envs.py:BothFlags", ("RL502", "error")),
    case("broken_envs.py:Endless", ("RL503", "warning")),
    case("broken_envs.py:EndsAtOnce", ("RL504", "warning")),
    case("broken_envs.py:EndsAtStepTwo", ("RL504", "warning")),
    case("broken_envs.py:NanReward", ("RL601", "error")),
    case("broken_goals.py:OtherReward", ("RL614", "error"), twin="broken_goals.py:Goal"),
    case("broken_goals.py:OneByOne", ("RL614", "error"), twin="broken_goals.py:RoundedReward"),
    case("broken_goals.py:NanComputed", ("RL614", "error")),
    case("broken_goals.py:NumberlessReward", ("RL614", "error"), twin="broken_goals.py:NestedGoal"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.parametrize(
    "name",
    [
        "broken_envs.py:Clean",
        pytest.param("broken_envs.py:CleanDict", marks=pytest.mark.slow),
        pytest.param("broken_repeats.py:FixedStartNoise", marks=pytest.mark.slow),
        pytest.param("broken_repeats.py:OwnWorld", marks=[pytest.mark.slow, pytest.mark.pybullet]),
        pytest.param("reach", marks=pytest.mark.slow),  # in test_processes.py by the command
    ],
)
def test_clean_is_clean(name):
    verdict = verdict_of(name)
    assert verdict.findings == []
    assert verdict.not_judged == {}
    assert {*verdict.judged, *verdict.not_applicable} == set(RULES)


OTHERS = [
    "Pendulum-v1",
    "Blackjack-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Acrobot-v1",
    "Taxi-v4",
    "CliffWalking-v1",
]


@pytest.mark.parametrize(
    "task",
    ["FrozenLake-v1", *(pytest.param(task, marks=pytest.mark.slow) for task in OTHERS)],
)
def test_gymnasiums_own_environments_have_no_errors(task):
    assert not {severity for _, severity in found(task)} & {"error"}


def test_hindsight_rewards_are_compared():
    (finding,) = findings("broken_goals.py:OtherReward", "RL614")
    # Each reward is 0.5 below what compute_reward says.
    assert finding.evidence["value"] - finding.evidence["expected"] == pytest.approx(0.5)


@pytest.mark.parametrize("name", ["NoReward", "LosesItsGoal"])
def test_hindsight_rewards_that_cannot_be_compared_are_the_matter_of_other_rules(name):
    verdict = verdict_of(f"broken_goals.py:{name}", "RL614")
    assert verdict.not_judged == {
        "RL614": "goals are missing or change their shape (RL101), or types are wrong (RL204)"
    }


def test_a_number_that_is_too_large_for_a_float_is_left_out():
    assert dict(find_numbers({"hash": 10**400, "terms": {"hash": 10**400, "distance": 1}})) == {"terms/distance": 1.0}


def test_out_of_range_is_placed():
    (finding,) = findings("broken_envs.py:OutOfRange", "RL103")
    assert re.match(
        r"observation\[[01]\] is [\d.]+ at step 30; the space allows \[-5, 5\]; \d+ of \d+ observations are outside",
        finding.message,
    )
    assert finding.evidence["step"] == 30
    assert finding.evidence["expected"] == [-5.0, 5.0]
    assert finding.evidence["value"] > 5.0
    assert {"seed", "episode"} <= finding.evidence.keys()


def test_exception_is_placed():
    (finding,) = findings("broken_envs.py:Raises", "RL207")
    assert finding.message.startswith("step 7 raised RuntimeError: joint 3 is gone (tests/checking/broken_envs.py:")
    assert finding.evidence["step"] == 7
    assert finding.evidence["seed"] == 1000


def test_names_of_a_tasks_observation_are_used():
    built = records_of("reach", "build").built
    # 7 joint positions, 7 velocities, then the hand.
    assert built.element(0, 15) == "hand[1]"
    assert built.max_steps == 120


def test_difference_is_named():
    (finding,) = findings("broken_repeats.py:GlobalRandom", "RL301")
    assert finding.message.startswith("reset twice with one seed: first difference at reset: observation[")
    assert finding.evidence["step"] == 0
    assert finding.evidence["seed"] == 1000
    assert finding.evidence["element"] in finding.message
    assert finding.evidence["relative_difference"] > 1e-3


def test_state_that_reset_keeps_is_named():
    (finding,) = findings("broken_repeats.py:OldActions", "RL301")
    assert finding.message.endswith("; a new process repeats it, so reset keeps state (self.actions, self.position)")


def test_state_without_effect_is_not_named():
    (finding,) = findings("broken_repeats.py:FirstEpisodeDiffers", "RL302")
    assert finding.message.endswith("; the first episode of an instance differs from all later ones")
    assert "self.kept" not in finding.fix


def test_chance_that_reset_keeps_is_no_missing_seed():
    verdict = verdict_of("broken_repeats.py:KeptChance", "RL308")
    assert verdict.not_judged["RL308"] == "an episode already depends on the previous one (RL301 to RL303)"


def test_what_a_nearer_rule_explains_is_not_judged():
    verdict = verdict_of("broken_repeats.py:NoisyStep", "RL303", "RL304", "RL305", "RL401", "RL402")
    assert {"RL303", "RL304", "RL305", "RL401", "RL402"} <= verdict.not_judged.keys()
    assert verdict.not_judged["RL305"] == "the same instance already differs from itself (RL301, RL302)"
    assert not {"RL303", "RL304", "RL305", "RL401", "RL402"} & set(verdict.judged)


def test_space_that_no_rule_can_look_into_is_said():
    verdict = verdict_of("broken_spaces.py:TextObservation", "RL101", "RL102", "RL103", "RL104")
    assert verdict.findings == []
    assert verdict.not_judged["observation['say']"] == "rules cannot examine a Text space"


def test_every_rule_has_an_environment_that_breaks_it():
    modules = [import_module(f"tests.checking.{file.stem}") for file in FOLDER.glob("test_*.py")]
    broken = {rule for module in modules for case in getattr(module, "CASES", []) for rule, _ in case.expected}
    assert broken | {rule for case in IN_PROCESSES for rule in case.rules} == set(RULES)


def test_rules_are_complete():
    for rule in RULES.values():
        assert re.fullmatch(r"RL\d{3}", rule.id)
        assert rule.meaning
        assert rule.fix
