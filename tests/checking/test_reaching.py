"""RL605, RL622, RL626, RL627, RL637, RL638: what plays that reach the goal pay, where the reward is one number."""

import pytest

from tests.checking.judging import case, check_case, mark_slow


def broken(name, twin, file="broken_reaching.py", **settings):
    return case(f"{file}:{name}", (name[:5], "warning"), twin=f"{file}:{twin}", **settings)


PHASES = "broken_phases.py"
CASES = [
    broken("RL605SailboatPaidPerStep", "Sailboat", slow=True),
    broken("RL627SailboatOldBuoy", "Sailboat", slow=True),
    broken("RL605DiscOldDistance", "DiscWithBlock", slow=True),
    broken("RL622DiscLeavesBlock", "DiscWithBlock", slow=True),
    broken("RL622DiscOtherAxes", "DiscWithBlock", slow=True),
    broken("RL622PointCopterAbove", "PointCopter", slow=True),
    broken("RL626SledTwoFrames", "Sled", "broken_reaching_bullet.py", pybullet=True, slow=True),
    broken("RL638RoverPaidForTheFirst", "RoverPhases", PHASES, pybullet=True),
    broken("RL638PointerPaidForTheFirst", "Pointer", PHASES, pybullet=True, slow=True),
    broken("RL638ArmPaidForTheFirst", "ArmPhases", PHASES, pybullet=True, slow=True),
    broken("RL637FlyerCountsFromTheStart", "FlyerSeeks", PHASES, pybullet=True, slow=True),
    broken("RL637BoatCountsFromTheStart", "BoatSeeks", PHASES, pybullet=True, slow=True),
    broken("RL637ReacherCountsFromTheStart", "ReacherSeeks", PHASES, pybullet=True, slow=True),
    broken("RL627TwoHandsOldGoal", "TwoHands", PHASES, pybullet=True, slow=True),
    broken("RL622TwoHandsStayAway", "TwoHands", PHASES, pybullet=True, slow=True),
    broken("RL622DoorWithoutASize", "Door", PHASES, pybullet=True, slow=True),
    broken("RL622SledLeavesCube", "Sled", "broken_reaching_bullet.py", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
