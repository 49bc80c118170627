"""What an observation holds: nothing that never changes, nothing twice, nothing hidden, nothing out of proportion."""

import dataclasses

import numpy as np
import pytest

from rlctl.check_env.families.features import copies_in
from rlctl.check_env.judge import judge
from tests.check_env.judging import case, check_case, findings, found, records_of, rules_of

BROKEN = "broken_observations.py"
CASES = [
    case(f"{BROKEN}:ConstantElement", ("RL110", "info"), twin=f"{BROKEN}:Wide"),
    case(f"{BROKEN}:ConstantCounter", ("RL110", "warning"), twin=f"{BROKEN}:Counter"),
    case(f"{BROKEN}:SameTwice", ("RL111", "info"), twin=f"{BROKEN}:Wide"),
    case(f"{BROKEN}:Degrees", ("RL111", "info"), twin=f"{BROKEN}:Wide"),
    case(f"{BROKEN}:Millimetres", ("RL112", "info"), twin=f"{BROKEN}:Wide"),
    case(f"{BROKEN}:HiddenGoal", ("RL114", "warning"), twin=f"{BROKEN}:SeenGoal"),
    case(f"{BROKEN}:HiddenGoalNoisyStart", ("RL114", "warning"), twin=f"{BROKEN}:NoisyReward"),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


CLEAN = [f"{BROKEN}:{name}" for name in ("Wide", "Counter", "SomeFlags", "SeenGoal", "NoisyReward", "ShownChance")]


@pytest.mark.parametrize("task", CLEAN)
def test_clean_is_clean(task):
    assert found(task, *rules_of("RL1")) == set()


def finding_of(name):
    (case,) = [each for each in CASES if each.broken == f"{BROKEN}:{name}"]
    (finding,) = findings(case.broken, *case.rules)
    return finding


def test_constant_elements_are_named_with_their_value():
    finding = finding_of("ConstantElement")
    assert finding.message == "1 of 4 elements of the observation never changed: observation[2] (0.25)"
    assert finding.evidence == {"value": 1, "expected": 0, "elements": ["observation[2]"]}
    assert finding_of("ConstantCounter").evidence["elements"] == ["observation['step']"]


def test_copies_are_named():
    assert finding_of("SameTwice").message == "observation[2] = observation[1]"
    # 1 - degrees(y): 180 / pi = 57.2958
    assert finding_of("Degrees").message == "observation[2] = -57.2958 * observation[1] +1"


def test_copies_among_many_elements_are_found_at_once():
    rows = np.random.default_rng(0).normal(size=(1000, 1000))
    rows[:, 700] = -2.0 * rows[:, 3] + 5.0
    rows[:, 900] = rows[:, 4]
    rows[:, 901] = rows[:, 5] + 1e-4 * rows[:, 6]  # nearly, not to float precision
    rows[:, 902] = rows[:, 903] = rows[:, 7] > 0  # equal flags may be so by chance
    exact, scaled = sorted(copies_in(rows, 1e-7), key=lambda pair: -pair[0])
    assert exact == (900, 4, 1.0, 0.0)
    assert scaled[:2] == (700, 3)
    assert scaled[2:] == pytest.approx((-2.0, 5.0))


def test_scales_matter_as_far_as_nothing_normalises():
    evidence = records_of(f"{BROKEN}:Millimetres")
    severities = []
    for normalizes in (None, False, True):
        findings = judge(dataclasses.replace(evidence, normalizes=lambda: normalizes)).findings  # noqa: B023
        severities.append([str(finding.severity) for finding in findings if finding.rule == "RL112"])
    assert severities == [["info"], ["warning"], []]


def test_two_episodes_show_what_is_hidden():
    evidence = finding_of("HiddenGoal").evidence
    # After the first step with the zero action: minus the distances from the start to two goals.
    goals = [np.random.default_rng(evidence[seed]).uniform(-1, 1, 2) for seed in ("seed", "other_seed")]
    distances = [float(np.linalg.norm(np.array([0.5, -0.3]) - goal)) for goal in goals]
    assert [evidence["value"], evidence["expected"]] == pytest.approx([-distance for distance in distances], abs=0.5)
    assert evidence["seed"] != evidence["other_seed"]
