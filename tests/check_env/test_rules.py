"""Each rule finds its mistake, and only that; `Clean` and its like come out clean.

Lives the environments in this process; what needs a process of its own is in `test_processes.py`.
"""

import re
import sys
from pathlib import Path

import pytest

from rlctl.check_env.child_process import run_part
from rlctl.check_env.evidence import Evidence
from rlctl.check_env.judge import judge
from rlctl.check_env.rules import RULES
from rlctl.env_spec import EnvSpec

BROKEN = Path(__file__).parent / "broken_envs.py"
PARTS = ("probe", "instances", "checkers")


def evidence_of(name, parts=PARTS):
    task = f"{BROKEN}:{name}" if name[0].isupper() and ":" not in name and "-v" not in name else name
    evidence = Evidence(task)
    for part in parts:
        # As in a new process: nothing that an earlier part left in the module.
        sys.modules.pop("broken_envs", None)
        for header, arrays in run_part(part, EnvSpec(task)):
            evidence.add(header, arrays)
    return evidence


def verdict_of(name, parts=PARTS):
    verdict = judge(evidence_of(name, parts))
    assert verdict.crashed == {}
    return verdict


def found(verdict):
    return {(finding.rule, str(finding.severity)) for finding in verdict.findings}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("OldGym", {("RL003", "error"), ("RL201", "error"), ("RL202", "error")}),
        ("WrongShape", {("RL101", "error")}),
        ("MissingKey", {("RL101", "error")}),
        ("Float64", {("RL102", "error")}),
        ("OutOfRange", {("RL103", "error")}),
        ("Rounding", {("RL103", "warning")}),
        ("NanObservation", {("RL104", "error")}),
        ("ReusedMemory", {("RL105", "warning")}),
        ("UnboundedActions", {("RL106", "error")}),
        ("WideActions", {("RL107", "info")}),
        ("OddImage", {("RL108", "warning")}),
        ("TupleObservation", {("RL109", "warning")}),
        ("FourValues", {("RL201", "error")}),
        ("NoSeed", {("RL202", "error")}),
        ("NoOptions", {("RL203", "warning")}),
        ("NumpyBool", {("RL204", "error")}),
        ("ArrayReward", {("RL205", "error")}),
        ("Float32Reward", {("RL205", "warning")}),
        ("NoneInfo", {("RL206", "error")}),
        ("Raises", {("RL207", "error")}),
        ("Exits", {("RL207", "error")}),
        ("NoSuperReset", {("RL210", "warning")}),
        ("GlobalRandom", {("RL301", "error")}),
        ("NoisyStep", {("RL302", "error")}),
        ("LeakyReset", {("RL303", "error")}),
        ("ClassCounter", {("RL304", "error")}),
        ("FixedStart", {("RL306", "warning")}),
        ("TimeInInfo", {("RL307", "warning")}),
        ("UnseededLater", {("RL308", "warning")}),
        ("Residue", {("RL301", "warning")}),
        ("SharedWorld", {("RL401", "error"), ("RL402", "error")}),
        ("CloseBreaks", {("RL402", "error")}),
        ("OnlyOne", {("RL403", "error")}),
        ("TimeLimitTerminates", {("RL501", "error")}),
        ("BothFlags", {("RL502", "error")}),
        ("Endless", {("RL503", "warning")}),
        ("EndsAtOnce", {("RL504", "warning")}),
        ("NanReward", {("RL601", "error")}),
    ],
)
def test_finds_the_mistake_and_only_that(name, expected):
    assert found(verdict_of(name)) == expected


@pytest.mark.parametrize("name", ["Clean", "CleanDict", "FixedStartNoise", "OwnWorld", "CartPole-v1", "reach"])
def test_clean_is_clean(name):
    verdict = verdict_of(name)
    assert found(verdict) == set()
    assert verdict.not_judged == {}
    assert set(verdict.judged) == {rule.id for rule in RULES}


@pytest.mark.parametrize(
    "task",
    ["Pendulum-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Acrobot-v1", "FrozenLake-v1", "Taxi-v4",
     "CliffWalking-v1", "Blackjack-v1"],
)  # fmt: skip
def test_gymnasiums_own_environments_have_no_errors(task):
    assert not {severity for _, severity in found(verdict_of(task, ("probe", "instances")))} & {"error"}


def test_out_of_range_is_placed():
    (finding,) = verdict_of("OutOfRange", ("probe",)).findings
    assert re.match(
        r"observation\[[01]\] is [\d.]+ at step 30; the space allows \[-5, 5\]; \d+ of \d+ observations are outside",
        finding.message,
    )
    assert finding.evidence["step"] == 30
    assert finding.evidence["expected"] == [-5.0, 5.0]
    assert finding.evidence["value"] > 5.0
    assert {"seed", "episode"} <= finding.evidence.keys()


def test_exception_is_placed():
    (finding,) = verdict_of("Raises", ("probe",)).findings
    assert finding.message.startswith("step 7 raised RuntimeError: joint 3 is gone (broken_envs.py:")
    assert finding.evidence["step"] == 7
    assert finding.evidence["seed"] == 1000


def test_names_of_a_tasks_observation_are_used():
    built = evidence_of("reach", ("probe",)).built
    # 7 joint positions, 7 velocities, then the hand.
    assert built.element(0, 15) == "hand[1]"
    assert built.max_steps == 120


def test_difference_is_named():
    (finding,) = verdict_of("GlobalRandom", ("probe", "instances")).findings
    assert finding.message.startswith("reset twice with one seed: first difference at reset: observation[")
    assert finding.evidence["step"] == 0
    assert finding.evidence["seed"] == 1000
    assert finding.evidence["element"] in finding.message
    assert finding.evidence["relative_difference"] > 1e-3


def test_what_a_nearer_rule_explains_is_not_judged():
    verdict = verdict_of("NoisyStep", ("probe", "instances"))
    assert {"RL303", "RL304", "RL305", "RL401", "RL402"} <= verdict.not_judged.keys()
    assert verdict.not_judged["RL305"] == "the same instance already differs from itself (RL301, RL302)"
    assert not {"RL303", "RL304", "RL305", "RL401", "RL402"} & set(verdict.judged)


def test_space_that_no_rule_can_look_into_is_said():
    verdict = verdict_of("TextObservation", ("probe", "instances"))
    assert verdict.findings == []
    assert verdict.not_judged["observation['say']"] == "no rule can look into a Text space"


def test_rules_are_complete():
    ids = [rule.id for rule in RULES]
    assert len(ids) == len(set(ids))
    for rule in RULES:
        assert re.fullmatch(r"RL\d{3}", rule.id)
        assert rule.meaning
        assert rule.fix
