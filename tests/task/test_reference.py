"""The rows that robots follow: starts from seeds, places with velocities, and distances, by hand."""

import contextlib

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.batch import WorldRngs
from rlctl.task.reference import Reference
from rlctl.task.rotations import from_axis, multiply
from rlctl.task.worlds import TaskWorlds
from tests.task.batches import HIPS, Stool
from tests.task.test_motion import make_motion

WORLDS = 3
EVERYWHERE = np.arange(WORLDS)


def make_reference(*lengths: int) -> Reference:
    return Reference([make_motion(length, 50.0) for length in lengths], HIPS, 0.02)


@pytest.fixture
def stool():
    """Three worlds of a stool whose clip has been located."""

    class Follower(Stool):
        reference = make_reference(100)

        def build(self, sim):
            super().build(sim)
            self.reference.locate(self.body, ["front"])

    worlds = TaskWorlds(Follower(), WORLDS)
    with contextlib.closing(worlds):
        worlds.reset(EVERYWHERE, [0, 1, 2])
        yield worlds.task


def test_rows_of_two_clips():
    reference = make_reference(40, 60)
    assert (reference.starts.tolist(), reference.ends.tolist()) == ([0, 40], [39, 99])
    # The last row of a clip follows itself.
    assert reference.following[[0, 38, 39, 40, 99]].tolist() == [1, 39, 39, 41, 99]
    assert reference.duration == pytest.approx(1.18)
    # 0.5 m and 1 rad in 0.1 s are 5 m/s and 10 rad/s; a joint bends by 0.1 rad in 0.02 s.
    assert reference.velocity[50] == pytest.approx([5.0, 0.0, 0.0])
    assert reference.angular_velocity[50] == pytest.approx([0.0, 0.0, 10.0])
    assert reference.joint_velocities[[0, 50], 0] == pytest.approx([5.0, 5.0])


def test_a_clip_without_a_joint_and_one_that_is_too_short():
    with pytest.raises(TaskError, match="motion clip: no column of the joint 'knee'"):
        Reference([make_motion()], ["knee"], 0.02)
    with pytest.raises(TaskError, match="less than two control steps"):
        Reference([make_motion(2, 50.0)], HIPS, 0.02)


def draw(reference: Reference, level: float) -> np.ndarray:
    rngs = WorldRngs([np.random.default_rng(seed) for seed in range(1000)])
    return reference.draw(rngs, np.full(1000, level))


def test_starts_are_anywhere_and_more_often_before_a_failure():
    reference = make_reference(200, 300)
    rows = draw(reference, 1.0)
    assert np.array_equal(rows, draw(reference, 1.0))
    # Half a second, 25 rows, of each clip is left.
    assert set(rows) <= {*range(175), *range(200, 475)}
    assert 0.33 < (rows < 200).mean() < 0.45  # 175 of 450 rows
    (level, succeeded) = reference.find_levels(np.array([400, 499]), np.array([True, False]))
    assert (level, succeeded) == (0.801, 1.0)
    # Half of the starts are in the 1.5 s, 75 rows, before row 400; of the others 76 of 450 rows.
    rows = draw(reference, level)
    assert 0.53 < ((rows >= 325) & (rows <= 400)).mean() < 0.64


def test_starts_before_a_failure_are_in_its_clip():
    reference = make_reference(200, 300)
    (level,) = reference.find_levels(np.array([210]), np.array([True]))
    rows = draw(reference, level)
    # Half are in the 10 rows of the second clip before the failure; of the others 11 of 450 rows.
    assert 0.46 < ((rows >= 200) & (rows <= 210)).mean() < 0.57


def test_a_robot_in_its_row_is_at_no_distance(stool):
    rows = np.array([0, 10, 60])
    stool.reference.place(stool.body, rows, EVERYWHERE)
    now = stool.reference.compare(stool.body, rows)
    for name in ("joints", "joint_velocities", "links", "heights", "tilt", "velocity", "turning", "heading", "place"):
        assert getattr(now, name) == pytest.approx(np.zeros(WORLDS), abs=1e-6), name


def test_distances_by_hand(stool):
    rows = np.array([10, 10, 10])
    reference = stool.reference
    reference.place(stool.body, rows, EVERYWHERE)
    turn, place = reference.orientation[10], reference.position[10] + [3.0, 4.0, 0.1]
    tilted = multiply(multiply(from_axis((0, 0, 1), 0.5), turn), from_axis((1, 0, 0), 0.3))
    stool.body.set_base(place, turn, worlds=np.array([0]))
    stool.body.set_base(place, tilted, worlds=np.array([1]))
    stool.body.set_joints(reference.joint_positions[rows[:1]] + [0.1, 0.3], worlds=np.array([2]))
    now = reference.compare(stool.body, rows)
    assert now.place[0] == pytest.approx(5.0, abs=0.02)  # the centre of mass is not in the frame's origin
    assert now.root_height[0] == pytest.approx(0.1, abs=0.02)
    assert now.tilt[1] == pytest.approx(0.3, abs=1e-6)
    assert now.heading[1] == pytest.approx(0.5, abs=1e-6)
    assert now.heading[0] == pytest.approx(0.0, abs=1e-6)
    assert now.joints[2] == pytest.approx(0.2)
    # 5 rad/s of one of two joints are missing.
    assert now.joint_velocities[2] == pytest.approx(5.0 / np.sqrt(2))


def test_what_a_policy_sees_is_of_the_next_row():
    reference = make_reference(50)
    tables = reference.tabulate()
    assert tables["joints"][:, 0] == pytest.approx(0.1 * np.append(np.arange(1, 50), 49))
    # Speeds of two joints, gravity, velocity forwards as the robot is turned by 0.2 rad, turning, height.
    expected = [5.0, 0.0, 0.0, 0.0, -1.0, 5 * np.cos(0.2), -5 * np.sin(0.2), 0.0, 0.0, 0.0, 10.0, 0.3]
    assert tables["motion"][0] == pytest.approx(expected)
