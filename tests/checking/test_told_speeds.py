"""RL820 of what a robot tells and pays."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_told_speeds.py"


def broken(name, twin, **settings):
    return case(f"{FILE}:{name}", ("RL820", "warning"), twin=f"{FILE}:{twin}", pybullet=True, **settings)


CASES = [
    broken("RL820FlyerTellsPerPhysicsStep", "FlyerTells", slow=True),
    broken("RL820PuckPaysPerPhysicsStep", "PuckPaysItsWay", slow=True),
    broken("RL820AirshipTellsPerPart", "AirshipTells", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
