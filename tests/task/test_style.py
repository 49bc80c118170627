"""`Style`: how far joints are from the poses and speeds of clips."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.motion import MotionClip
from rlctl.task.style import Style

NAMES = ["left", "right"]
OTHER_SIDE = (2, 1)


def make_clip(positions, rate: float = 50.0) -> MotionClip:
    """A clip of two joints."""
    frames = len(positions)
    root = np.tile([0.0, 0.0, 1.0], (frames, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1))
    return MotionClip("swing", rate, *root, NAMES, np.array(positions, float))


# The left joint turns at 1 rad/s, the right one does not.
RAMP = make_clip([[0.02 * row, 0.5] for row in range(10)])


def test_a_row_of_the_clip_has_the_style_whenever_it_comes():
    style = Style([RAMP], NAMES, 0.02)
    found = style.measure(np.array([[0.14, 0.5], [0.04, 0.5]]), np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert found == pytest.approx([0.0, 0.0], abs=1e-3)


def test_positions_and_speeds_count():
    style = Style([RAMP], NAMES, 0.02)
    # The right joint is 0.3 rad away: root of 0.3^2 / 2. Standing still: 1 rad/s counts as 0.05 rad.
    found = style.measure(np.array([[0.1, 0.8], [0.1, 0.5]]), np.array([[1.0, 0.0], [0.0, 0.0]]))
    assert found == pytest.approx([0.3 / np.sqrt(2), 0.05 / np.sqrt(2)], abs=1e-3)


def test_mirror_images_count_for_robots_with_two_sides():
    mirrored = np.array([[0.5, 0.1]]), np.array([[0.0, 1.0]])
    assert Style([RAMP], NAMES, 0.02).measure(*mirrored) > 0.25
    assert Style([RAMP], NAMES, 0.02, OTHER_SIDE).measure(*mirrored) == pytest.approx(0.0, abs=1e-3)
    turned = np.array([[-0.5, -0.1]]), np.array([[0.0, -1.0]])
    assert Style([RAMP], NAMES, 0.02, (-2, -1)).measure(*turned) == pytest.approx(0.0, abs=1e-3)


def test_clips_of_other_rates_and_joint_orders():
    style = Style([make_clip([[0.04 * row, 0.5] for row in range(5)], rate=25.0)], NAMES[::-1], 0.02)
    assert style.measure(np.array([[0.5, 0.06]]), np.array([[0.0, 1.0]])) == pytest.approx(0.0, abs=1e-3)


def test_a_world_has_the_same_bits_among_others():
    rng = np.random.default_rng(0)
    style = Style([make_clip(rng.normal(size=(500, 2)))], NAMES, 0.02, OTHER_SIDE)
    positions, velocities = rng.normal(size=(2, 64, 2))
    together = style.measure(positions, velocities)
    alone = [style.measure(positions[k : k + 1], velocities[k : k + 1])[0] for k in range(64)]
    assert together.tolist() == alone


def test_a_world_that_is_not_finite_stays_alone():
    positions = np.array([[np.nan, 0.5], [0.1, 0.5]])
    found = Style([RAMP], NAMES, 0.02).measure(positions, np.array([[1.0, 0.0], [1.0, 0.0]]))
    assert np.isnan(found[0])
    assert found[1] == pytest.approx(0.0, abs=1e-6)


def test_a_clip_that_lacks_a_joint():
    with pytest.raises(TaskError, match="no column of the joint 'middle'"):
        Style([RAMP], ["middle"], 0.02)
