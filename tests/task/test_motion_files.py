"""Clips of other programs: orders that are found, rates, and what is refused in one line."""

import json

import numpy as np
import pytest

from rlctl.errors import UsageError
from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion_files import RobotJoints, read_clip

LOW, HIGH = np.array([-1.0, -0.5, -2.0, -2.0]), np.array([1.0, 0.5, 0.0, 0.0])
NAMES = ["hip_joint", "ankle_joint", "left_elbow", "right_elbow"]
JOINTS = RobotJoints(
    "robot.xml",
    NAMES,
    breadth_first=["left_elbow", "right_elbow", "hip_joint", "ankle_joint"],
    low=LOW,
    high=HIGH,
    rest=np.array([0.0, 0.0, -0.1, -0.2]),
)
TILTED = np.array([0.1, 0.0, 0.0, np.sqrt(1 - 0.01)])  # x, y, z, w
POSE = np.array([0.9, 0.4, -1.5, -1.8])


def make_rows(order: str = "xyzw", pose=POSE, frames: int = 4) -> np.ndarray:
    row = [0.1, 0.2, 0.3, *TILTED[["xyzw".index(axis) for axis in order]], *pose]
    return np.tile(row, (frames, 1))


def write(folder, rows, name="clip_30hz.csv", header=""):
    path = folder / name
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    return str(path)


def read(file, **options):
    return read_clip(file, JOINTS, ClipOptions(**options))


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_the_order_of_quaternions_is_found_and_printed(tmp_path, order):
    motion, (note, *_) = read(write(tmp_path, make_rows(order)))
    assert motion.root_orientation[0] == pytest.approx(TILTED)
    assert f"quaternions {order} (found: the root is upright)" in note
    assert "4 frames at 30 Hz (its name), 0.10 s" in note
    assert (motion.joint_names, motion.joint_positions[0]) == (NAMES, pytest.approx(POSE))


def test_what_is_given_counts_more_than_what_is_found(tmp_path):
    motion, (note, *_) = read(write(tmp_path, make_rows()), quaternion="wxyz", rate=60.0, frames="1:4")
    assert motion.root_orientation[0] == pytest.approx([0.0, 0.0, TILTED[3], 0.1])
    assert (motion.rate, len(motion)) == (60.0, 3)
    assert "at 60 Hz (--rate)" in note
    assert "wxyz (--quaternion)" in note


def test_isaacs_order_of_joints_is_found_by_the_limits(tmp_path):
    motion, (note, *_) = read(write(tmp_path, make_rows(pose=POSE[[2, 3, 0, 1]])))
    assert motion.joint_positions[0] == pytest.approx(POSE)
    assert "breadth-first, as Isaac Lab has it: 0 values beyond the limits, 16 in the model's order" in note


def test_columns_by_their_names(tmp_path):
    header = "time,root_qw,root_qx,root_qy,root_qz,Root_Pos_X,Root_Pos_Y,Root_Pos_Z,left_elbow_joint,hip"
    times = np.arange(5) / 50
    rows = np.column_stack([times, *[np.full(5, value) for value in (*TILTED[[3, 0, 1, 2]], 1, 2, 3, -1.0, 0.5)]])
    motion, notes = read(write(tmp_path, rows, "clip.csv", header))
    assert (motion.rate, motion.root_position[0].tolist()) == (50.0, [1.0, 2.0, 3.0])
    assert motion.root_orientation[0] == pytest.approx(TILTED)
    assert motion.joint_positions[0] == pytest.approx([0.5, 0.0, -1.0, -0.2])
    assert notes[1] == "clip.csv has no column for ankle_joint, right_elbow: constant"


def test_columns_by_the_names_that_a_user_gives(tmp_path):
    motion, _ = read(write(tmp_path, make_rows(pose=[0.5, 9.0, -1.0])), joints=("hip_joint", "-", "left_elbow"))
    assert motion.joint_positions[0] == pytest.approx([0.5, 0.0, -1.0, -0.2])


def test_joints_that_turn_the_other_way(tmp_path):
    file = write(tmp_path, make_rows(pose=POSE * [1, 1, -1, 1]))
    _, notes = read(file)
    assert notes[1] == (
        "finding: clip_30hz.csv: beyond the limits, and within them with the other sign: left_elbow; give -left_elbow "
        "for left_elbow in --clip-joints"
    )
    motion, notes = read(file, joints=(*NAMES[:2], f"-{NAMES[2]}", NAMES[3]))
    assert motion.joint_positions[0] == pytest.approx(POSE)
    assert len(notes) == 1


def write_json(folder, content) -> str:
    (folder / "clip.txt").write_text(json.dumps(content))
    return str(folder / "clip.txt")


def test_json_frames(tmp_path):
    frames = make_rows().tolist()
    motion, (note, *_) = read(write_json(tmp_path, {"LoopMode": "Wrap", "FrameDuration": 0.01667, "Frames": frames}))
    assert motion.rate == pytest.approx(59.988)
    assert motion.joint_positions[0] == pytest.approx(POSE)
    assert "(its FrameDuration)" in note


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"frames": []}, "JSON with frames; expected Frames, a list of rows of numbers"),
        ({"Frames": []}, "JSON with Frames; expected"),
        ({"Frames": [[0.0] * 11, [0.0] * 10]}, "frame 1 is not a row of 11 numbers"),
        ({"Frames": [[0.0] * 11, [None] * 11]}, "frame 1 is not a row of 11 numbers"),
        ({"Frames": [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *POSE]] * 2}, "2 frames; a clip has at least 3"),
    ],
)
def test_json_that_is_no_clip(tmp_path, content, problem):
    with pytest.raises(UsageError, match=problem):
        read(write_json(tmp_path, content))


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_a_table_of_names_and_hardly_a_row(tmp_path, rows):
    header = "time,root_x,root_y,root_z,root_qx,root_qy,root_qz,root_qw,hip_joint"
    lines = [header, *["0,0,0,1,0,0,0,1,0.1"] * rows]
    (tmp_path / "clip.csv").write_text("\n".join(lines))
    with pytest.raises(UsageError, match=f"{rows} frames; a clip has at least 3"):
        read(str(tmp_path / "clip.csv"))


def test_a_time_before_columns_without_names(tmp_path):
    rows = np.column_stack([np.arange(4) / 60, make_rows()])
    motion, (note, *_) = read(write(tmp_path, rows, "clip.csv"))
    assert (motion.rate, motion.root_position[0].tolist()) == (60.0, [0.1, 0.2, 0.3])
    assert "its first column" in note


def test_npz_of_mjlab_and_isaac_lab(tmp_path):
    frames, links = 6, 3
    body = np.zeros((frames, links, 3))
    body[:, 0] = 0.1, 0.2, 0.3
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (frames, links, 1))
    turns[:, 0] = TILTED[[3, 0, 1, 2]]
    joints = np.tile(POSE, (frames, 1))
    file = tmp_path / "motion.npz"
    np.savez(file, fps=[50], joint_pos=joints, body_pos_w=body, body_quat_w=turns, joint_vel=0 * joints)
    motion, (note, *_) = read(str(file))
    assert (motion.rate, len(motion)) == (50.0, 6)
    assert motion.root_position[0] == pytest.approx([0.1, 0.2, 0.3])
    assert motion.root_orientation[0] == pytest.approx(TILTED)
    assert "quaternions wxyz (the file's names)" in note


def test_npz_of_retargeting(tmp_path):
    file = tmp_path / "motion.npz"
    rows = make_rows()
    np.savez(file, fps=30.0, dof_pos=rows[:, 7:], root_pos=rows[:, :3], root_rot=rows[:, 3:7], dof_names=NAMES)
    motion, (note, *_) = read(str(file))
    assert motion.root_orientation[0] == pytest.approx(TILTED)
    assert "joints by their names" in note


def test_an_npz_that_is_a_pickle_is_refused(tmp_path):
    file = tmp_path / "motion.npz"
    np.savez(file, joint_pos=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UsageError, match=r"--motion: .*motion\.npz"):
        read(str(file))


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("walk.bvh", "retarget it first, with GMR"),
        ("walk.pkl", "is a pickle"),
        ("walk.mp4", "give a .csv, .npz, or .json or .txt file"),
        ("walk.csv", "no file"),
    ],
)
def test_other_files_are_refused(tmp_path, name, problem):
    with pytest.raises(UsageError, match=problem):
        read(str(tmp_path / name))


@pytest.mark.parametrize(
    ("rows", "options", "problem"),
    [
        (make_rows(pose=[1.0, 2.0]), {}, "2 columns of joints without names, and robot.xml has 4 joints"),
        (make_rows(frames=1), {}, "1 frames; a clip has at least 3"),
        (make_rows(pose=[1.0, np.nan, 0.0, 0.0]), {}, "frame 0 is not finite in column 8"),
        (2 * make_rows(), {}, "frame 0 has a quaternion of length 2, expected 1"),
        (make_rows()[:, :6], {}, "6 columns; a clip without names has"),
        (make_rows(), {"joints": ("hip_joint", "knee", "-", "-")}, "has no joint 'knee'"),
        (make_rows(), {"joints": ("hip_joint", "hip", "-", "-")}, "two columns are the joint 'hip_joint'"),
        (make_rows(), {"joints": ("hip_joint",)}, "1 names, and clip_30hz.csv has 4 columns of joints"),
        (make_rows(), {"joints": ("-",) * 4}, "none of its columns is a joint"),
        (make_rows(), {"quaternion": "zyxw"}, "give xyzw or wxyz"),
        (make_rows(), {"frames": "3:9"}, "has the frames 0:4"),
        (make_rows(), {"frames": "all"}, "give FIRST:LAST"),
    ],
)
def test_clips_that_do_not_fit_are_refused(tmp_path, rows, options, problem):
    with pytest.raises(UsageError, match=problem):
        read(write(tmp_path, rows), **options)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "the file is empty"),
        ("1,2,3\n1,2\n", "line 2 has 2 columns, the first has 3"),
        ("a,b\n1,x\n", "line 2: could not convert string to float"),
        ("hip_joint,left_elbow\n0,0\n0,0\n0,0\n", "no column for 'x' of the root"),
    ],
)
def test_damaged_tables_are_refused(tmp_path, text, problem):
    file = tmp_path / "clip.csv"
    file.write_text(text)
    with pytest.raises(UsageError, match=problem):
        read(str(file))


def test_a_rate_is_asked_for(tmp_path):
    with pytest.raises(UsageError, match="no times and no rate; add --rate 30"):
        read(write(tmp_path, make_rows(), "clip.csv"))
