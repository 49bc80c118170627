"""RL836: an action that is multiplied by its limit twice."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_limits.py"


def broken(name, twin, **settings):
    return case(f"{FILE}:{name}", ("RL836", "warning"), twin=f"{FILE}:{twin}", pybullet=True, slow=True, **settings)


CASES = [
    broken("RL836BargeScalesTwice", "Barge"),
    broken("RL836TorqueArmScalesTwice", "TorqueArm"),
    broken("RL836BulletArmScalesTwice", "BulletTorqueArm"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
