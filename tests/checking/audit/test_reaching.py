"""What is brought to a goal, so that a task calls it a success."""

from pathlib import Path

import numpy as np
import pytest

from rlctl.checking.audit import reaching
from rlctl.checking.audit.play_world import PlayWorld
from rlctl.checking.instance import Context
from rlctl.engine import MUJOCO
from rlctl.environments.spec import EnvSpec


@pytest.mark.slow
def test_a_robot_on_wheels_is_moved_to_its_goal_on_the_ground():
    pytest.importorskip("mujoco")
    context = Context(EnvSpec(f"{Path(__file__).parent / 'rover.py'}:Rover", sim=MUJOCO))
    world = PlayWorld(context.build())
    goal = reaching.find_goal(world, 7, 0)
    assert isinstance(goal.mover, reaching.BaseMover)
    way = reaching.find_way(world, goal, 7, 0)
    assert 0.6 <= np.linalg.norm(way.goal[:2]) <= 1.2
    assert way.goal[2] == pytest.approx(0.1, abs=0.01)  # it stays on its wheels
