"""Mistakes of robots whose states, goals, terms and wishes have other forms and names than those of other tests."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")


def broken(file, name, twin, **settings):
    return case(f"{file}.py:{name}", (name[:5], "warning"), twin=f"{file}.py:{twin}", **settings)


def wheels(name):
    return broken("broken_wheels", name, "Wheels", pybullet=True, slow=True)


CASES = [
    broken("broken_hindsight", "RL126RoverParksInDegrees", "RoverParksStraight"),
    broken("broken_hindsight", "RL126RoverParksWithinANumber", "RoverParksStraight"),
    broken("broken_quadrotor", "RL115QuadrotorActsLate", "Quadrotor"),
    broken("broken_quadrotor", "RL124QuadrotorWrongWay", "Quadrotor"),
    broken("broken_quadrotor", "RL616QuadrotorLateReward", "Quadrotor", slow=True),
    broken("broken_quadrotor", "RL630QuadrotorSignedRates", "Quadrotor", slow=True),
    broken("broken_quadrotor", "RL632QuadrotorOtherElement", "Quadrotor"),
    broken("broken_quadrotor", "RL832QuadrotorTurnsFast", "Quadrotor"),
    *(
        broken("broken_way_points", name, "WayPoints", slow=True)
        for name in ("RL125WayPointsTurned", "RL618WayPointsLookRound", "RL627WayPointsOldGoal")
    ),
    wheels("RL123WheelsInTheWorld"),
    wheels("RL124WheelsTurnedTwice"),
    wheels("RL616WheelsLateReward"),
    wheels("RL620WheelsActionWithItself"),
    wheels("RL632WheelsOtherWish"),
    wheels("RL833WheelsDistance"),
    wheels("RL833WheelsOtherLink"),
    broken("broken_steps", "RL631GripperOneFinger", "GripperHolds", slow=True),
    broken("broken_steps", "RL816GripperOpensOutwards", "Gripper", slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


def test_an_action_may_act_late_on_purpose():
    assert found("broken_quadrotor.py:QuadrotorWithLatency", "RL115") == set()


@pytest.mark.slow
def test_a_touch_is_no_grasp():
    assert found("broken_steps.py:GripperHoldsAnything", "RL631") == set()
