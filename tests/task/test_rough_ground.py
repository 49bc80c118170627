"""Rough ground: heights from a seed, where they are in the world."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task import rough_heights
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.sim import PybulletSim


def test_heights_follow_from_the_seed():
    first = rough_heights(3, size=(4, 2), cell=0.1, roughness=0.2)
    np.testing.assert_array_equal(first, rough_heights(3, size=(4, 2), cell=0.1, roughness=0.2))
    assert (first != rough_heights(4, size=(4, 2), cell=0.1, roughness=0.2)).all()
    assert first.shape == (41, 21)  # 4 m / 0.1 m + 1
    assert 0 <= first.min() < 0.01
    assert 0.19 < first.max() <= 0.2


def test_flat_where_robots_start():
    heights = rough_heights(0, size=(4, 4), cell=0.5, roughness=1.0, flat_radius=0.5)
    assert heights[4, 4] == heights[3, 4] == heights[4, 5] == 0  # 0 m and 0.5 m from the centre
    full = rough_heights(0, size=(4, 4), cell=0.5, roughness=1.0)
    assert heights[2, 4] == full[2, 4]  # 1 m
    # sqrt(0.5) m from the centre: (0.7071 - 0.5) / 0.5
    assert heights[3, 3] == pytest.approx(0.4142 * full[3, 3], rel=1e-3)


def test_mistakes():
    with pytest.raises(TaskError, match=r"^terrain: roughness -0.1 m is negative$"):
        rough_heights(0, size=(4, 4), cell=0.5, roughness=-0.1)
    with pytest.raises(TaskError, match=r"^terrain: 0.5 m x 4 m is less than two cells of 0.5 m$"):
        rough_heights(0, size=(0.5, 4), cell=0.5, roughness=0.1)


@pytest.mark.pybullet
def test_heights_are_where_they_should_be():
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    heights = rough_heights(0, size=(4, 2), cell=0.1, roughness=0.2)
    ground = sim.add_height_field("ground", heights, cell=0.1)
    assert ground.fixed
    for row, column in ((5, 3), (30, 15), (20, 10)):
        x, y = (row - 20) * 0.1 + 1e-4, (column - 10) * 0.1 + 1e-4  # beside the point, not on an edge
        _, _, _, hit, _ = pybullet.rayTest((x, y, 3), (x, y, -3), physicsClientId=sim.client)[0]
        assert hit[2] == pytest.approx(heights[row, column], abs=5e-4)
    sim.close()
