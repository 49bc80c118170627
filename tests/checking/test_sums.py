"""RL622: sums of differences in place of distances; RL627: goals of objects that are seen in a frame that turns."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, *consequences):
    file = "broken_sums.py"
    expected = [(rule, "warning") for rule in (name[:5], *consequences)]
    return case(f"{file}:{name}", *expected, twin=f"{file}:{twin}", pybullet=True, slow=True)


CASES = [
    broken("RL622RoverAddsSigns", "RoverAddsSizes", "RL605"),
    broken("RL622ArmAddsSigns", "ArmAddsSizes"),
    broken("RL622ReacherAddsSigns", "ReacherAddsSizes"),
    broken("RL622PlateAddsSigns", "PlateNear"),
    broken("RL627PlateOldGoal", "Plate"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
