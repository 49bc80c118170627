"""Screw drive: a scripted screwing, the thread, where things start, what is observed and paid, episodes that repeat."""

import math

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.model_faults import find_model_faults
from rlctl_manipulation.screw_drive import HOME, LEAD, TOP_SPEED, TRAVEL, ScrewDrive
from tests.manipulation.scripted import assert_episodes_repeat, play

STEPS = 300


@pytest.fixture
def env():
    env = TaskEnv(ScrewDrive())
    env.reset(seed=0)
    yield env
    env.close()


def drive(task, stop=0.0004):
    """Go over the socket, turn and press until the head is `stop` [m] above the block."""
    over = math.hypot(*task.from_tip[:2]) < 0.001
    height = -task.from_tip[2]
    left = TRAVEL - task.travel > stop
    down = (0.03 if left else 0.0) if over else 10 * (height - 0.01)
    action = np.array([*(10 * task.from_tip[:2]), down, 8.0 if over and left else 0.0]) / TOP_SPEED
    return np.clip(action, -1, 1).astype(np.float32)


@pytest.mark.slow_except("1")
@pytest.mark.pybullet
@pytest.mark.parametrize("seed", range(4))
def test_the_screw_can_be_driven(env, seed):
    _, info = play(env, seed, drive, STEPS)
    assert info["is_success"]
    assert info["metrics"]["driven"] > 0.95
    assert info["metrics"]["excess_torque"] == 0
    travel, turned = env.task.screw.joint_positions
    assert travel == pytest.approx(turned * LEAD / (2 * math.pi), abs=2e-5)  # the thread holds


@pytest.mark.slow
@pytest.mark.pybullet
def test_a_blocked_screw_stops_the_spindle(env):
    _, info = play(env, 0, lambda task: drive(task, stop=-1.0), STEPS)
    # The spindle has 1 N m, of which 0.5 are safe. The head lies on the block.
    assert info["metrics"]["excess_torque"] == pytest.approx(0.5, abs=0.02)
    assert env.task.travel == pytest.approx(TRAVEL, abs=1e-4)


@pytest.mark.pybullet
def test_pressing_alone_drives_no_screw(env):
    """37 N on a lead of 5 mm are 0.03 N m, and the thread's friction is 0.2 N m."""
    task = env.task
    start = task.travel
    for _ in range(150):
        env.step(drive(task) * np.array([1, 1, 1, 0], np.float32))
    assert np.linalg.norm(task.force) > 25
    assert task.travel - start < 1e-4


def test_what_is_observed(env):
    task, space = env.task, env.observation_space
    assert space.shape == (3 + 4 + 3 + 3 + 1 + 1 + 3 + 1,)
    seen = task.observe()
    assert seen["left_to_drive"] == pytest.approx(TRAVEL - task.start)
    assert (np.abs(seen["close_up"]) <= 0.01).all()
    # The bit turned by a tenth of a radian from the socket, and by a quarter turn more, which looks the same.
    for quarters in (0, 1):
        yaw = task.block_yaw - task.screw.joint_positions[1] - 0.1 + quarters * math.pi / 2
        task.gantry.set_joints(np.array([*task.gantry.joint_positions[:3], -yaw]))
        task.update()
        assert task.observe()["yaw_error"] == pytest.approx(0.1, abs=1e-6)


def test_forces_are_along_the_gantrys_axes(env):
    """Pressed against the head's side along x, whatever way the bit is turned, the force is along x."""
    task = env.task
    for turned in (0.0, math.pi / 2):
        env.reset(seed=1)
        target = task.from_tip + task.gantry.link_position("tip") - (0.03, 0.0, 0.005)
        x, y, z = task.gantry.joint_positions[:3] + (target - task.gantry.link_position("tip")) * (1, 1, -1)
        task.gantry.set_joints(np.array([x, y, z, turned - task.block_yaw]))
        for _ in range(20):
            env.step(np.array([0.3, 0, 0, 0], np.float32))
        force = task.observe()["wrist_force"]
        assert force[0] > 10  # what the spindle pushes the bit with
        assert abs(force[0]) > abs(force[1])


def test_where_things_start(env):
    sockets, travels, starts = [], [], []
    for seed in range(60):
        env.reset(seed=seed)
        sockets.append(env.task.screw.link_position("screw"))
        travels.append(env.task.start)
        starts.append(env.task.gantry.joint_positions - HOME)
    low, high = np.min(sockets, axis=0), np.max(sockets, axis=0)
    np.testing.assert_allclose(low[:2], [-0.05, -0.1], atol=0.01)
    np.testing.assert_allclose(high[:2], [0.15, 0.1], atol=0.01)
    assert 0 <= min(travels) < 5e-4 < 5.5e-3 < max(travels) <= 6e-3
    # The socket's mouth is 3 cm above the block, less what the screw is in already.
    np.testing.assert_allclose(np.array(sockets)[:, 2], 0.13 - np.array(travels), atol=1e-6)
    assert np.abs(starts).max(axis=0) == pytest.approx([0.05, 0.05, 0.005, math.pi / 4], rel=0.1)


def test_a_head_start_is_on_the_way_or_in_the_socket():
    env = TaskEnv(ScrewDrive(head_start=1.0))  # half of the episodes have the whole way behind them
    there = 0
    for seed in range(60):
        env.reset(seed=seed)
        task = env.task
        aside, height = math.hypot(*task.from_tip[:2]), -task.from_tip[2]
        if aside < 0.0015:
            there += 1
            assert -0.005 <= height <= 0.005
            assert abs(task.yaw_error) < 0.21
        else:
            assert height > 0.004
        env.step(np.zeros(4, np.float32))
        assert np.linalg.norm(task.force) < 5  # nothing is stuck in anything
    assert 20 < there < 45
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("randomize", [False, True])
def test_episodes_repeat_bit_for_bit(randomize):
    assert_episodes_repeat(ScrewDrive, drive, STEPS, randomize)


def test_friction_that_the_spindle_cannot_turn():
    with pytest.raises(TaskError, match=r"^thread_friction: 1 N m is not in \[0, 1\), the spindle's torque$"):
        TaskEnv(ScrewDrive(thread_friction=1.0))


def test_nothing_is_wrong_with_the_models(env):
    assert [fault for body in env.sim.bodies.values() for fault in find_model_faults(body)] == []
