"""RL708, RL709: a command that adds up the actions, without an end, or for no joint."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_windup.py"


def broken(name, twin, **settings):
    return case(f"{FILE}:{name}", (name[:5], "warning"), twin=f"{FILE}:{twin}", pybullet=True, **settings)


CASES = [
    broken("RL708GateRunsOn", "Gate"),
    broken("RL708ArmRunsOn", "ArmAddsUp", slow=True),
    broken("RL708BulletArmRunsOn", "BulletArmAddsUp", slow=True),
    broken("RL709ArmForgetsTheWrist", "ArmAddsUp"),
    broken("RL709BulletArmForgetsTheLast", "BulletArmShowsTargets", slow=True),
    broken("RL709GripperArmForgetsTheShoulder", "ArmWithGripper", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
