"""RL123, RL124, RL129: one axis of a velocity in the wrong frame, or both far from each other."""

import pytest

from tests.checking.judging import case, check_case, found, mark_slow

pytest.importorskip("mujoco")
FILE = "broken_velocity_axes.py"


def broken(name, twin, rule, **settings):
    return case(f"{FILE}:{name}", (rule, "warning"), twin=f"{FILE}:{twin}", **settings)


CASES = [
    broken("RL123CartSeesX", "CartSeesXAndYaw", "RL123", pybullet=True),
    broken("RL123FlyerSeesWorld", "FlyerSeesWorldAndDirection", "RL123", pybullet=True, slow=True),
    broken("RL123PuckSeesX", "PuckSeesXAndYaw", "RL123", pybullet=True, slow=True),
    broken("RL124CartTurnsBack", "CartSeesSpeed", "RL124", pybullet=True),
    broken("RL124FlyerTurnsBack", "FlyerSeesSpeed", "RL124", pybullet=True, slow=True),
    broken("RL124PuckTurnsBack", "PuckSeesSpeed", "RL124", pybullet=True, slow=True),
    broken("RL129BaseInTheWorld", "BaseInTheWorldAndYaw", "RL129", pybullet=True, slow=True),
    broken("RL129BaseSeesX", "BaseSeesXAndDirection", "RL129", pybullet=True, slow=True),
    broken("RL124BaseTurnsBack", "Base", "RL124", pybullet=True, slow=True),
    broken("RL129BaseForwardsBack", "BaseForwards", "RL129", pybullet=True, slow=True),
    broken("RL129BaseForwardsInTheWorld", "BaseForwardsInTheWorldAndYaw", "RL129", pybullet=True, slow=True),
]


@pytest.mark.parametrize("case", mark_slow(CASES), ids=lambda case: case.broken)
def test_finds_the_mistake_and_only_that(case):
    check_case(case)


@pytest.mark.slow
@pytest.mark.pybullet
@pytest.mark.parametrize("robot", ["CartSeesXAndDirection", "PuckPushedInTheWorld"])
def test_a_heading_that_is_seen_or_does_not_matter_is_no_hidden_one(robot):
    assert found(f"{FILE}:{robot}", "RL123", "RL124") == set()
