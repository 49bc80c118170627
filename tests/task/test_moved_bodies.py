"""Bodies whose velocity is set, in both engines alike, and a task's world that is moved after the physics."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.rotations import from_axis

pytest.importorskip("mujoco")
ENGINES = [pytest.param(PybulletSim, marks=pytest.mark.pybullet), MujocoSim]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", ["cube_small.urdf", "a1.urdf"])
def test_a_free_body_gets_a_velocity_and_turns(engine, model):
    """Of its centre of mass, in the world's frame, however it is turned: the trunk's is beside its origin."""
    with closing(engine(control_dt=0.02, substeps=4)) as sim:
        body = sim.load("body", model, position=(0.0, 0.0, 1.0))
        body.set_base((0.0, 0.0, 1.0), from_axis((1, 2, 3), 1.0))
        body.add_velocity((0.5, -0.2, 0.1), (0.1, 0.2, 0.8))
        body.add_velocity((0.5, 0.0, 0.0))
        np.testing.assert_allclose(body.base_velocity, (1.0, -0.2, 0.1), atol=1e-6)
        np.testing.assert_allclose(body.base_angular_velocity, (0.1, 0.2, 0.8), atol=1e-6)


def test_what_is_moved_after_the_physics_is_judged():
    with closing(EnvSpec("walk").make()) as env:
        env.reset(seed=0)
        worlds, body = env.unwrapped.worlds, env.unwrapped.worlds.sim_of(0).bodies["robot"]

        def move():
            body.set_base((0.0, 0.0, 0.28))
            body.add_velocity((0.7, 0.0, 0.0))

        worlds.after_physics = move
        env.unwrapped.set_commands({"lin_vel_x": 0.7, "lin_vel_y": 0.0, "ang_vel_z": 0.0})
        *_, info = env.step(np.zeros(12, np.float32))
        assert info["metrics"]["tracking"] == pytest.approx(1.0)
        worlds.after_physics = None
        *_, info = env.step(np.zeros(12, np.float32))
        assert info["metrics"]["tracking"] < 0.99
