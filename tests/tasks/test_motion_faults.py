"""What is wrong with a clip is found before any training, with its frames."""

import dataclasses

import numpy as np
import pytest

from rlctl.task.motion import MotionClip
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.rotations import from_axis
from rlctl.tasks.motion_faults import find_faults, find_shift, list_frames, measure_heights
from tests.tasks.test_new_walk import write_dog

FRAMES, RATE, STANDING = 120, 30.0, 0.34
BENT = np.array([0.0, 0.5, -1.0] * 4 + [0.4])


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    return MujocoSim(control_dt=0.02, substeps=1).load("robot", write_dog(tmp_path_factory.mktemp("dog")))


@pytest.fixture
def clip(dog):
    """A dog that stands still on its feet."""
    joints = np.tile(BENT, (FRAMES, 1))
    motion = MotionClip(
        name="clip",
        rate=RATE,
        root_position=np.tile([0.0, 0.0, STANDING], (FRAMES, 1)),
        root_orientation=np.tile([0.0, 0.0, 0.0, 1.0], (FRAMES, 1)),
        joint_names=dog.joint_names,
        joint_positions=joints,
    )
    shift = find_shift(measure_heights(dog, motion))
    assert 0.0 < abs(shift) < 0.15
    motion.root_position[:, 2] += shift
    return motion


def judge(dog, clip):
    return find_faults(dog, clip, measure_heights(dog, clip))


def test_a_dog_that_stands_has_no_findings(dog, clip):
    heights = measure_heights(dog, clip)
    assert heights.lowest == pytest.approx(np.zeros(FRAMES), abs=1e-9)
    assert find_shift(heights) == 0.0
    assert judge(dog, clip) == []


def test_feet_through_the_floor(dog, clip):
    clip.root_position[10:14, 2] -= 0.03
    assert judge(dog, clip) == ["clip: up to 3.0 cm through the floor in frames 10-13"]


def test_a_robot_in_the_air(dog, clip):
    clip.root_position[:, 2] += 0.3
    assert judge(dog, clip) == ["clip: at least 30.0 cm above the floor in every frame"]


def test_joints_beyond_their_limits(dog, clip):
    clip.joint_positions[20:40, 12] = 0.6 + 0.1  # of the neck, up to 0.6 rad
    (fault,) = judge(dog, clip)
    assert fault == "clip: beyond the limits of the model: neck by up to 6 degrees, in frames 20-39"


def test_joints_in_degrees(dog, clip):
    degrees = dataclasses.replace(clip, joint_positions=np.rad2deg(clip.joint_positions))
    assert "clip: the joints look like degrees: give them in radians" in judge(dog, degrees)


def test_a_wrong_rate_makes_joints_too_fast(dog, clip):
    turns = 0.25 * np.sin(2 * np.pi * np.arange(FRAMES) / 15)
    clip.joint_positions[:, 0] = turns  # at most 0.105 rad a frame
    assert judge(dog, clip) == []
    (fault,) = judge(dog, dataclasses.replace(clip, rate=300.0))
    assert fault.startswith("clip: faster than the motors: front_left_hip up to 30.5 rad/s, in frames ")
    assert fault.endswith("is 300 Hz the right rate? Otherwise give --rate")


def test_jumps(dog, clip):
    clip.root_position[60:, 0] += 0.5
    clip.root_orientation[90:] = from_axis((0, 0, 1), 1.0)
    (fault,) = judge(dog, clip)
    assert fault.startswith("clip: jumps to the frame after frames 59, 89: to frame 60 ")
    assert fault.endswith("the root moves by 0.5 m")


def test_a_centre_of_mass_that_falls_too_fast(dog, clip):
    # A jump as gravity has it, played at twice its rate: 4 times the acceleration.
    times = (np.arange(18) - 9) / RATE
    clip.root_position[40:58, 2] += 9.81 / 2 * (0.3**2 - times**2)
    assert judge(dog, clip) == []
    (fault,) = judge(dog, dataclasses.replace(clip, rate=2 * RATE))
    assert "falls 4.0 times as fast as gravity pulls in frames" in fault
    assert "(30 Hz would fit)" in fault


def test_frames_as_text():
    flags = np.zeros(100, bool)
    flags[[3, 4, 5, 9]] = True
    assert list_frames(flags) == "frames 3-5, 9"
    flags[::10] = True
    assert list_frames(flags) == "frames 0, 3-5, 9-10, 20 and 7 more ranges"
