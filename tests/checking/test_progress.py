"""RL622: goals that go away and pay, success that costs; RL125: goals turned the wrong way. On robots that turn."""

import pytest

from rlctl.checking.rules.rl622_being_far_from_the_goal_pays import _explain_few
from tests.checking.judging import case, check_case, findings, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, file="broken_progress.py", **settings):
    return case(f"{file}:{name}", (name[:5], "warning"), twin=f"{file}:{twin}", **settings)


CASES = [
    broken("RL622BoatGoesAway", "BoatSeeks", pybullet=True, slow=True),
    broken("RL622FlyerGoesAway", "FlyerSeeks", slow=True),
    broken("RL622CartGoesAway", "CartSeeks", slow=True),
    broken("RL622PuckGoesAway", "PuckSeeks", pybullet=True, slow=True),
    broken("RL622ArmCostsSuccess", "ArmPaysSuccess", slow=True),
    broken("RL622FlyerCostsSuccess", "FlyerPaysSuccess", slow=True),
    broken("RL622CartCostsSuccess", "CartPaysSuccess", slow=True),
    broken("RL622PuckCostsSuccess", "PuckPaysSuccess", pybullet=True, slow=True),
    broken("RL622RoverTurnsAway", "RoverTurns", file="broken_headings.py"),
    broken("RL622DroneTurnsAway", "DroneTurns", file="broken_headings.py", slow=True),
    broken("RL622DialTurnsAway", "Dial", file="broken_headings.py", slow=True),
    broken("RL125CartTurnsBack", "CartSeeks", slow=True),
    broken("RL125FlyerTurnsBack", "FlyerSeeks", slow=True),
    broken("RL125HopperTurnsBack", "HopperSeeks", slow=True),
    broken("RL125PuckTurnsBack", "PuckSeeks", pybullet=True, slow=True),
    broken("RL125ArmHandTurnsBack", "ArmSeesFromHand", slow=True),
    broken("RL125ReacherHandTurnsBack", "ReacherSeesFromHand", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("RL622BoatGoesAway", ("comes", "nearer in a step", "where it goes as far away")),
        ("RL622ArmCostsSuccess", ("the reward is larger at any distance to the goal",)),
    ],
)
def test_finding_says_what_pays(name, words):
    (finding,) = findings(f"broken_progress.py:{name}", "RL622")
    assert [word for word in words if word not in finding.message] == []


def test_too_few_successes_are_explained():
    assert _explain_few(1) == (
        "with the goal put where the robot is, 1 of 10 episodes had a success; the comparison needs 3"
    )
