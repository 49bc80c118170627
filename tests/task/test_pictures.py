"""A camera's pictures as an observation: bytes in a Dict space."""

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from rlctl.task.env import TaskEnv
from tests.task.tasks import Cart


class Seen(Cart):
    """The cube from the side, at every fourth step."""

    observation_layout = "dict"
    events = {}

    def reset(self, rng):
        super().reset(rng)
        self.steps = 0

    def act(self, action):
        self.steps += 1

    def observe(self):
        if self.steps % 4 == 0:
            self.picture = self.sim.render(32, 24, eye=(0.5, 0, 0.1), target=(0, 0, 0.1))
        return {"camera": self.picture, "height": self.cube.base_position[2:]}


@pytest.mark.pybullet
def test_pictures_are_bytes():
    env = TaskEnv(Seen())
    assert env.observation_space["camera"] == spaces.Box(0, 255, (24, 32, 3), np.uint8)
    assert env.observation_space["height"].dtype == np.float32
    pictures = [env.reset(seed=0)[0]["camera"]]
    pictures += [env.step(np.zeros(1))[0]["camera"] for _ in range(4)]
    assert pictures[0].dtype == np.uint8
    np.testing.assert_array_equal(pictures[0], pictures[3])  # as slow as the camera
    assert (pictures[3] != pictures[4]).any()  # the cube falls
    again = env.reset(seed=0)[0]["camera"]
    np.testing.assert_array_equal(again, pictures[0])
    check_env(env, skip_render_check=True)
    env.close()
