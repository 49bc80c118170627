"""RL633: commands whose direction nothing pays."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")


def broken(name, twin):
    file = "broken_lengths.py"
    return case(f"{file}:{name}", ("RL633", "warning"), twin=twin, pybullet=True, slow=True)


CASES = [
    broken("RL633QuadrotorAnyDirection", "broken_quadrotor.py:Quadrotor"),
    broken("RL633WheelsAnyDirection", "broken_wheels.py:Wheels"),
    broken("RL633FlyerAnyDirection", "broken_lengths.py:FlyerFollows"),
    broken("RL633CartAnyDirection", "broken_lengths.py:CartFollows"),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["FlyerGated", "FlyerStays"])
def test_a_limit_of_the_length_and_a_robot_at_rest_say_nothing(robot):
    assert found(f"broken_lengths.py:{robot}", "RL633") == set()
