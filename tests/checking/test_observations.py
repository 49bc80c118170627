"""What an observation holds: nothing that never changes, and nothing hidden."""

import pytest

from tests.checking.judging import case, check_case, findings, found, mark_slow, rules_of

BROKEN = "broken_observations.py"
CASES = [
    case(f"{BROKEN}:RL110ConstantElement", ("RL110", "info"), twin=f"{BROKEN}:Wide", slow=True),
    case(f"{BROKEN}:RL110ConstantCounter", ("RL110", "info"), twin=f"{BROKEN}:RL110Counter", slow=True),
    case(f"{BROKEN}:RL110ConstantSpeed", ("RL110", "warning"), twin=f"{BROKEN}:RL110Speed", slow=True),
    case(f"{BROKEN}:RL114HiddenGoal", ("RL114", "warning"), twin=f"{BROKEN}:RL114SeenGoal"),
    case(f"{BROKEN}:RL114HiddenGoalNoisyStart", ("RL114", "warning"), twin=f"{BROKEN}:RL114NoisyReward"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


CLEAN = [
    f"{BROKEN}:{name}"
    for name in ("Wide", "RL110Counter", "SomeFlags", "RL114SeenGoal", "RL114NoisyReward", "ShownChance")
]


@pytest.mark.slow
@pytest.mark.parametrize("task", CLEAN)
def test_clean_is_clean(task):
    assert found(task, *rules_of("RL1")) == set()


@pytest.mark.slow
def test_a_bandit_shows_nothing():
    assert found(f"{BROKEN}:Bandit", "RL110", "RL114") == {("RL110", "info")}


def finding_of(name):
    (case,) = [each for each in CASES if each.broken == f"{BROKEN}:{name}"]
    (finding,) = findings(case.broken, *case.rules)
    return finding


@pytest.mark.slow
def test_constant_elements_are_named_with_their_value():
    finding = finding_of("RL110ConstantElement")
    assert finding.message == "1 of 4 elements of the observation never changed: observation[2] (0.25)"
    assert finding.evidence == {"value": 1, "expected": 0, "elements": ["observation[2]"]}
    assert finding_of("RL110ConstantCounter").evidence["elements"] == ["observation['step']"]


def test_reward_shows_what_is_hidden():
    finding = finding_of("RL114HiddenGoal")
    assert finding.evidence["element"] == "self.goal"
    assert finding.evidence["value"] != finding.evidence["expected"]
