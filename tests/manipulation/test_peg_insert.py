"""Peg insert: a scripted insertion, where things start, what is observed and paid, episodes that repeat."""

import math

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.model_faults import find_model_faults
from rlctl_manipulation.peg_insert import HOME, TOP_SPEED, PegInsert
from tests.manipulation.scripted import assert_episodes_repeat, play

UPPER_ARM, FOREARM = 0.25, 0.2  # [m]
STEPS = 150


@pytest.fixture
def env():
    env = TaskEnv(PegInsert())
    env.reset(seed=0)
    yield env
    env.close()


def find_angles(point):
    """Return the angles of shoulder and elbow [rad] that bring the peg over a point: law of cosines."""
    x, y = point[:2]
    elbow = math.acos((x**2 + y**2 - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM))
    shoulder = math.atan2(y, x) - math.atan2(FOREARM * math.sin(elbow), UPPER_ARM + FOREARM * math.cos(elbow))
    return np.array([shoulder, elbow])


def insert(task):
    """Go over the hole and turn the peg like it, then down."""
    height = -task.from_tip[2]
    over = task.aside() < 0.001 and abs(task.yaw_error) < 0.02
    down = 0.05 if over or height < 0 else height - 0.008
    error = [*(find_angles(task.mouth) - task.arm.joint_positions[:2]), down, task.yaw_error]
    action = np.array([10, 10, 20, 8]) * error / TOP_SPEED
    return np.clip(action, -1, [1, 1, 0.5, 1]).astype(np.float32)


@pytest.mark.slow_except("1")
@pytest.mark.pybullet
@pytest.mark.parametrize("seed", range(4))
def test_the_peg_can_be_inserted(env, seed):
    _, info = play(env, seed, insert, STEPS)
    assert info["is_success"]
    assert info["metrics"]["inserted"] == 1.0
    assert env.task.inserted() == pytest.approx(0.03, abs=1e-3)  # on the hole's ground
    # The slide pushes with 40 N, and the peg stands on the ground of the hole.
    assert 35 < np.linalg.norm(env.task.force) < 60
    assert info["metrics"]["excess_force"] == pytest.approx(np.linalg.norm(env.task.force) - 20)


@pytest.mark.pybullet
@pytest.mark.parametrize(("aside", "turned"), [(0.004, 0.0), (0.0, 0.4)])
def test_a_peg_beside_the_hole_or_turned_does_not_go_in(env, aside, turned):
    """2 mm of play to each side, and a square of 16 mm turned by 0.4 rad is 21 mm wide."""
    task = env.task
    target = task.mouth + np.array([aside, 0.0, 0.0])
    angles = find_angles(target)
    wrist = task.hole_yaw + turned - angles.sum()
    task.arm.set_joints(np.array([*angles, 0.03, (wrist + math.pi) % (2 * math.pi) - math.pi]))
    for _ in range(60):
        _, _, _, _, info = env.step(np.array([0, 0, 0.5, 0], np.float32))
    assert info["is_success"] is False
    assert info["metrics"]["inserted"] < 0.1
    assert info["metrics"]["excess_force"] > 5


def test_what_is_observed(env):
    task, space = env.task, env.observation_space
    assert space.shape == (4 + 4 + 3 + 3 + 1 + 3,)
    # The peg over the hole, 5 mm above it and turned like it: no way to go but down.
    angles = find_angles(task.mouth)
    slide = float(task.arm.joint_positions[2]) - task.from_tip[2] - 0.005
    task.arm.set_joints(np.array([*angles, slide, task.hole_yaw - angles.sum()]))
    task.update()
    seen = task.observe()
    np.testing.assert_allclose(seen["hole_from_tip"], [0, 0, -0.005], atol=1e-6)
    assert seen["yaw_error"] == pytest.approx(0, abs=1e-6)
    # A quarter turn of a square is none; and 1 cm along the forearm is the first number.
    task.arm.set_joints(task.arm.joint_positions + np.array([0, 0, 0, math.pi / 2 - 0.1]))
    forearm = angles.sum()
    task.mouth = task.mouth + 0.01 * np.array([math.cos(forearm), math.sin(forearm), 0])
    task.update()
    seen = task.observe()
    np.testing.assert_allclose(seen["hole_from_tip"], [0.01, 0, -0.005], atol=1e-6)
    task.from_tip = np.array([0.0, 0.0, -0.05])
    assert task.observe()["close_up"][2] == -0.01  # as far as it sees
    assert seen["yaw_error"] == pytest.approx(0.1, abs=1e-6)


def test_a_peg_is_in_only_on_the_holes_axis(env):
    env.task.from_tip = np.array([0.0, 0.001, 0.02])
    assert env.task.inserted() == 0.02
    env.task.from_tip = np.array([0.0, 0.003, 0.02])
    assert env.task.inserted() == 0


def test_where_things_start(env):
    mouths, starts = [], []
    for seed in range(60):
        env.reset(seed=seed)
        mouths.append(env.task.mouth)
        starts.append(env.task.arm.joint_positions - HOME)
        wanted = env.task.mouth - (0, 0, 0.05)
        np.testing.assert_allclose(env.task.hole.base_position, wanted, atol=1e-9)
    away = np.linalg.norm(np.array(mouths)[:, :2], axis=1)
    assert 0.28 <= away.min() < 0.29 < 0.39 < away.max() <= 0.4
    assert np.abs(starts).max(axis=0) == pytest.approx([0.2, 0.2, 0.01, 0.3], rel=0.1)


@pytest.mark.slow_except("False")
@pytest.mark.parametrize("randomize", [False, True])
def test_episodes_repeat_bit_for_bit(randomize):
    assert_episodes_repeat(PegInsert, insert, STEPS, randomize)


def test_a_hole_that_is_not_so_deep():
    with pytest.raises(TaskError, match=r"^depth: 0.03 m is not between 0 and the hole's 0.03 m$"):
        TaskEnv(PegInsert(depth=0.03))


def test_nothing_is_wrong_with_the_models(env):
    assert [fault for body in env.sim.bodies.values() for fault in find_model_faults(body)] == []
