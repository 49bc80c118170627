"""RL630: costs with signs; RL831, RL832: steps of another time than is declared; RL830: contacts in another order."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin, file, **settings):
    return case(f"{file}:{name}", (name[:5], "warning"), twin=f"{file}:{twin}", pybullet=True, **settings)


SIGNS, TIMES, ORDERS, INCOMES = (f"broken_{word}.py" for word in ("signs", "step_times", "orders", "incomes"))
CASES = [
    broken("RL630RoverReverses", "RoverSaves", SIGNS, slow=True),
    broken("RL630DroneBrakes", "DroneThrottles", SIGNS, slow=True),
    broken("RL630FlyerPaysReverse", "FlyerTells", SIGNS, slow=True),
    broken("RL831FlyerStepsOnce", "FlyerSteps", TIMES),
    broken("RL831HopperStepsTwice", "HopperSteps", TIMES, slow=True),
    broken("RL831PuckStepsOnce", "PuckSteps", TIMES, slow=True),
    broken("RL832GliderTurnsTooFast", "Glider", TIMES),
    broken("RL832TrolleySwingsTooSlowly", "Trolley", TIMES, slow=True),
    broken("RL832ArmElbowTooFast", "Arm", TIMES, slow=True),
    broken("RL830HopperFeetFirst", "HopperFeet", ORDERS, slow=True),
    broken("RL830ArmLeansUnseen", "ArmLeans", ORDERS, slow=True),
    broken("RL830CrawlerFloorFirst", "CrawlerFeetFirst", ORDERS, slow=True),
    broken("RL830PusherNeverStands", "PusherStands", ORDERS, slow=True),
    broken("RL605RoverRestsNear", "RoverFindsLittle", INCOMES, slow=True),
    broken("RL605ArmRestsNear", "ArmFindsLittle", INCOMES, slow=True),
    broken("RL605PuckCountsFromTheStart", "PuckFindsLittle", INCOMES, slow=True),
    case(
        f"{INCOMES}:RL605RL637CartCountsFromTheStart",
        ("RL605", "warning"),
        ("RL637", "warning"),
        twin=f"{INCOMES}:CartFindsLittle",
        pybullet=True,
        slow=True,
    ),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
def test_a_robot_that_drifts_away_from_where_it_began_does_not_rest_there():
    # A part of the observation is 0, as is the place of the drone in its first steps.
    assert found(f"{SIGNS}:DroneThrottles", "RL605") == set()


@pytest.mark.slow
@pytest.mark.pybullet  # its file has robots of both engines
def test_an_infinite_number_of_frames_is_no_number_of_steps():
    assert found("broken_step_times.py:FlyerWaitsForNoFrame", "RL831", "RL832") == set()
