"""RL826, RL832 where only loops say how many steps of the physics a step has."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, **settings):
    return case(f"broken_substeps.py:{name}", (name[:5], "warning"), twin=f"broken_substeps.py:{twin}", **settings)


CASES = [
    broken("RL832AirshipTurnsFast", "Airship"),
    broken("RL826AirshipCountsAll", "Airship"),
    broken("RL832PressSlidesFast", "Press", slow=True),
    broken("RL826PressSlowClock", "Press", slow=True),
    broken("RL826HopperTimeLeft", "HopperTimeLeft", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
