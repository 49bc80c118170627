"""RL127: a place and a velocity that are observed in two frames."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")
FRAMES = "broken_two_frames.py"


def broken(name, twin, **settings):
    return case(f"{FRAMES}:{name}", ("RL127", "warning"), twin=twin, pybullet=True, **settings)


CASES = [
    case(
        f"{FRAMES}:RL125AirshipGoal",
        ("RL125", "warning"),  # the line that turns the goal; RL127 and RL129 would say what follows from it
        twin="broken_substeps.py:Airship",
        pybullet=True,
    ),
    broken("RL127AirshipWind", f"{FRAMES}:AirshipInWorld", slow=True),
    broken("RL127FlyerSeesWind", f"{FRAMES}:FlyerSees", slow=True),
    broken("RL127PuckSeesWorld", f"{FRAMES}:PuckSees", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_a_velocity_that_is_turned_the_wrong_way_is_told_once():
    assert found("broken_waypoints.py:RL124OmniWrongWay", "RL124", "RL127") == {("RL124", "warning")}
