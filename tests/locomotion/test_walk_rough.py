"""Rough ground: its heights, where episodes begin at which level, and what the critic sees of it."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl_locomotion.walk_rough import WalkRough

pytest.importorskip("mujoco")


def test_heights_between_the_points_of_the_grid():
    task = WalkRough()
    task.heights = np.array([[0.0, 0.0, 0.0], [0.0, 0.04, 0.02], [0.0, 0.0, 0.0]])  # the middle is at 0, 0
    places = np.array(
        [
            [0.0, 0.0],
            [0.0, WalkRough.cell / 2],
            [WalkRough.cell / 2, WalkRough.cell / 2],
            [-WalkRough.cell, 0.0],
            [99.0, 99.0],
        ]
    )
    # Half way to 0.02 it is 0.03; in the middle of 0.04, 0.02, 0 and 0 it is 0.015; outside it is that of the edge.
    np.testing.assert_allclose(task.find_heights(places), [0.04, 0.03, 0.015, 0.0, 0.0], atol=1e-9)


def test_episodes_begin_where_the_ground_is_as_rough_as_their_level():
    with closing(EnvSpec("walk-rough").make()) as env:
        inner, spread = env.unwrapped, {}
        for level in (0.0, 0.5, 1.0):
            inner.set_level(level)
            env.reset(seed=3)
            inner.worlds.show_critic(task=True, events=True)
            row = inner.worlds.observe_privileged(np.zeros(1, int))[0]
            columns = np.cumsum([0, *inner.worlds.critic.sizes.values()])
            at = list(inner.worlds.critic.sizes).index("ground")
            spread[level] = np.ptp(row[columns[at] : columns[at + 1]])
        assert spread[0.0] < 0.01 < spread[0.5] < spread[1.0] <= 0.05
        assert list(inner.worlds.critic.sizes)[:4] == ["velocity", "height", "foot_heights", "ground"]
        assert row[3] == pytest.approx(0.3, abs=0.04)  # of the trunk above the ground, at the start
        assert (row[4:8] > -0.005).all()  # no foot is in the ground


def test_bumps_that_are_too_high():
    with pytest.raises(TaskError, match=r"rough: bumps of 0\.3 m; give a height from 0 to 0\.1 m"):
        EnvSpec("walk-rough", {"rough": 0.3}).make()
