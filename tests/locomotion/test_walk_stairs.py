"""Stairs: their heights, where they are how high, and the steps that the robot must take in training."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl_locomotion.walk_stairs import WalkStairs


def test_flights_go_up_and_down():
    heights = WalkStairs(step=0.1).draw_heights()
    assert heights.shape == (481, 881)  # 24 m and 44 m in cells of 5 cm, and one point more
    # Treads of 30 cm are 6 points long. Five steps up, five down, from the edge of the ground at x = -12 m.
    np.testing.assert_allclose(heights[:66:6, 0], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0], atol=1e-12)
    assert (heights == heights[:, :1]).all()


def test_steps_are_low_where_episodes_of_a_low_level_begin():
    task = WalkStairs()
    # Full height to |y| = 6 m, none at 18 m: half of it at 12 m.
    shares = np.clip(task.find_roughness(np.array([0.0, 6.0, -12.0, 12.0, -18.0, 22.0])), 0.0, 1.0)
    np.testing.assert_allclose(shares, [1.0, 1.0, 0.5, 0.5, 0.0, 0.0])


@pytest.mark.parametrize("settings", [{"step": 0.2}, {"step": -0.1}])
def test_steps_that_are_too_high(settings):
    with pytest.raises(TaskError, match=r"step: steps of -?0\.\d m; give a height from 0 to 0\.15 m"):
        WalkStairs(**settings).draw_heights()


@pytest.mark.parametrize("must_step", [False, True])
def test_a_missed_step_ends_the_episode_if_it_must_step(must_step):
    with closing(EnvSpec("walk-stairs", {"must_step": must_step}).make()) as env:
        env.unwrapped.set_level(0.0)
        env.reset(seed=0)
        # It stands. More than 90 % of the swing are wanted from asin(0.9) / (2 pi) of the period on: 0.107 s, step six.
        ended = [env.step(np.zeros(12, np.float32))[2] for _ in range(6)]
        assert ended == [False] * 5 + [must_step]
        assert (env.unwrapped.task.foot_heights < 0.01).all()
