"""RL128: a velocity that is observed in another frame than the one in which the reward compares it with a command."""

import pytest

from tests.checking.judging import case, check_case, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_commands.py"


def broken(name, twin, **settings):
    return case(f"{FILE}:{name}", ("RL128", "warning"), twin=f"{FILE}:{twin}", pybullet=True, **settings)


CASES = [
    broken("RL128FlyerIsSentNorth", "FlyerIsSent", slow=True),
    broken("RL128PuckIsSentNorth", "PuckIsSent", slow=True),
    broken("RL128AirshipIsSentTwice", "AirshipIsSent"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)
