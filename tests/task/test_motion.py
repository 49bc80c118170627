"""Clips as rows of time: their file, their rate, and rows between frames, by hand."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.motion import MotionClip, find_rate, read_motion, write_motion
from rlctl.task.rotations import from_axis


def make_motion(frames: int = 5, rate: float = 10.0) -> MotionClip:
    """A clip that moves 0.1 m forwards, turns 0.2 rad to the left and bends one of two joints by 0.1 rad a frame."""
    numbers = np.arange(float(frames))
    return MotionClip(
        name="clip",
        rate=rate,
        root_position=np.stack([0.1 * numbers, 0 * numbers, 0 * numbers + 0.3], axis=1),
        root_orientation=from_axis((0, 0, 1), 0.2 * numbers),
        joint_names=["front_hip", "back_hip"],
        joint_positions=np.stack([0.1 * numbers, 0 * numbers], axis=1),
    )


def test_a_file_has_the_clip(tmp_path):
    motion = make_motion()
    (tmp_path / "clip.csv").write_bytes(write_motion(motion))
    read = read_motion(tmp_path / "clip.csv")
    assert (read.name, read.rate, read.joint_names) == ("clip", 10.0, ["front_hip", "back_hip"])
    assert read.root_position == pytest.approx(motion.root_position)
    assert read.root_orientation == pytest.approx(motion.root_orientation, abs=1e-5)
    assert read.joint_positions == pytest.approx(motion.joint_positions)


def test_a_clip_of_minutes_is_read_back(tmp_path):
    # 130 s at 30 Hz: with six digits, its last times would be 0.033 or 0.034 s apart.
    (tmp_path / "clip.csv").write_bytes(write_motion(make_motion(3900, 30.0)))
    assert read_motion(tmp_path / "clip.csv").rate == 30.0


def test_rows_between_frames():
    # 5 frames at 10 Hz last 0.4 s: at 20 Hz that is 9 rows, every other one in the middle of two frames.
    rows = make_motion().resample(20.0)
    assert len(rows) == 9
    assert rows.root_position[3] == pytest.approx([0.15, 0.0, 0.3])
    assert rows.root_orientation[3] == pytest.approx(from_axis((0, 0, 1), 0.3), abs=1e-4)
    assert rows.joint_positions[:, 0] == pytest.approx(0.05 * np.arange(9))
    # At 4 Hz only the times 0 and 0.25 s are in the clip.
    assert make_motion().resample(4.0).joint_positions[:, 0] == pytest.approx([0.0, 0.25])


def test_quaternions_of_either_sign_are_the_same_orientation():
    motion = make_motion()
    motion.root_orientation[2] *= -1
    turned = motion.resample(20.0).root_orientation
    assert np.abs((turned * make_motion().resample(20.0).root_orientation).sum(axis=1)) == pytest.approx(1.0)


def test_rates_of_times():
    assert find_rate([0.0, 0.0333, 0.0667, 0.1], "clip") == 30.0
    with pytest.raises(TaskError, match=r"0\.5 s from frame 1 to 2, and 0\.1 s elsewhere"):
        find_rate([0.0, 0.1, 0.6, 0.7], "clip")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("time,root_x\n0,1\n1,2\n", "no column 'root_y'"),
        ("", "no column 'time'"),
        ("time,root_x,root_y,root_z,root_qx,root_qy,root_qz,root_qw\n0,0,0,0,0,0,0,1\n", "at least 2 rows"),
    ],
)
def test_files_that_are_no_clip(tmp_path, text, problem):
    (tmp_path / "clip.csv").write_text(text)
    with pytest.raises(TaskError, match=problem):
        read_motion(tmp_path / "clip.csv")
