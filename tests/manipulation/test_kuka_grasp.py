"""Kuka grasp: a scripted grasp, where things start, what is observed and paid, episodes that repeat."""

import math
import time

import numpy as np
import pytest

from rlctl.engine import read_engine
from rlctl.errors import TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.events import EventSettings
from rlctl_manipulation.kuka_grasp import GRASP_HEIGHT, HAND, HAND_HIGH, HAND_LOW, KukaGrasp, wrap

pytestmark = pytest.mark.pybullet

BY_THE_WALL = 4  # seed; the block lies where a finger comes near a wall of the tray


def steer(task):
    """Move towards the block, and turn until the fingers close on its narrow side."""
    yaw, (x, y) = task.gripper_yaw(), task.block_in_gripper
    way = np.array([math.cos(yaw) * x + math.sin(yaw) * y, math.sin(yaw) * x - math.cos(yaw) * y])
    turn = -wrap(2 * (task.block_yaw - math.pi / 2)) / 2
    return np.clip([*(60 * way), 6 * turn], -1, 1).astype(np.float32)


def play(env, seed, policy):
    """Return all observations and rewards, shape (T + 1, size + 1), and the last info."""
    rows, info = [np.append(env.reset(seed=seed)[0], 0.0)], {}
    for _ in range(env.max_steps):
        observation, reward, _, _, info = env.step(policy(env.task))
        rows.append(np.append(observation, reward))
    return np.array(rows), info


@pytest.fixture
def env():
    env = TaskEnv(KukaGrasp())
    yield env
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize("seed", [0, 1, BY_THE_WALL])
def test_a_block_can_be_lifted_and_held(engine, seed):
    env = TaskEnv(KukaGrasp(), sim=read_engine(engine))
    _, info = play(env, seed, steer)
    assert info["is_success"]
    assert env.task.block_height > 0.15  # [m], it rested at -0.175
    terms = info["reward_terms"]
    # Held: 0.5 + 1 + 1
    assert terms["grasp"] + terms["lift"] + terms["held"] == pytest.approx(2.5)
    # And KukaBulletEnv would pay 10,000, less 10 per metre to the hand, which is a gripper's length away.
    assert 9_995 < info["metrics"]["original"] < 10_000
    env.close()


@pytest.mark.slow
def test_a_wall_near_a_finger_does_not_end_the_descent(env):
    env.reset(seed=BY_THE_WALL)
    while env.task.descending:
        env.step(steer(env.task))
    # It once ended 16 mm higher, where closing fingers miss the block. A control step is 2 mm.
    assert env.task.gripper[2] == pytest.approx(GRASP_HEIGHT, abs=0.004)


@pytest.mark.slow
def test_a_miss_is_no_success(env):
    rows, info = play(env, 0, lambda task: np.array([0.0, -1.0, 0.0], np.float32))
    assert not info["is_success"]
    assert info["metrics"]["grasp"] == 0.0
    assert info["metrics"]["original"] < -1.0
    assert rows[1:-1, -1].max() < 0


def test_where_things_start(env):
    blocks, yaws = [], []
    for seed in range(60):
        env.reset(seed=seed)
        blocks.append(env.task.block.base_position)
        yaws.append(env.task.block_yaw + env.task.gripper_yaw())
    x, y, z = np.transpose(blocks)
    assert 0.55 <= x.min() < 0.555
    assert 0.66 < x.max() <= 0.67
    assert 0 <= y.min() < 0.01
    assert 0.19 < y.max() <= 0.2
    assert z == pytest.approx(np.full(60, -0.15))
    assert np.ptp(np.mod(yaws, math.pi)) > 2.5  # [rad]; a half turn is drawn from
    assert env.task.arm.link_position(HAND) == pytest.approx((0.537, 0, 0.5), abs=1e-3)


def test_what_is_observed(env):
    observation, _ = env.reset(seed=3)
    task = env.task
    assert observation.shape == (9,)
    # The block is where the gripper's own axes say, from above: x along the fingers, y mirrored.
    yaw, (x, y) = task.gripper_yaw(), observation[6:8]
    way = np.array([math.cos(yaw) * x + math.sin(yaw) * y, math.sin(yaw) * x - math.cos(yaw) * y])
    assert task.gripper[:2] + way == pytest.approx(task.block.base_position[:2], abs=1e-6)
    seen = TaskEnv(KukaGrasp(observe_height=True))
    observation, _ = seen.reset(seed=3)
    assert observation.shape == (15,)
    assert observation[9] == pytest.approx(-0.15)
    assert observation[10:14] == pytest.approx([-0.3, 0, 0.3, 0])  # [rad]
    assert observation[14] == 1.0
    seen.close()


@pytest.mark.slow
def test_the_hand_descends_and_stays_in_its_box(env):
    env.reset(seed=0)
    for _ in range(60):
        env.step(np.array([1.0, 1.0, 0.0]))
    # 0.5 m - 60 * 2 mm, and a target that the motors are a little behind of
    assert env.task.arm.link_position(HAND)[2] == pytest.approx(0.38, abs=0.01)
    assert env.task.target[:2].tolist() == HAND_HIGH.tolist()
    for _ in range(100):
        env.step(np.array([-1.0, -1.0, 0.0]))
    assert env.task.target[:2].tolist() == HAND_LOW.tolist()


def test_alignment_by_hand(env):
    env.reset(seed=0)
    task = env.task

    def misaligned(angle):
        yaw = task.gripper_yaw() + angle
        task.block.set_base((0.6, 0.1, -0.17), (0, 0, math.sin(yaw / 2), math.cos(yaw / 2)))
        return task.rewards(np.zeros(3, np.float32))["misaligned"]

    assert misaligned(math.pi / 2) == pytest.approx(0, abs=1e-6)  # across the fingers
    assert misaligned(-math.pi / 2) == pytest.approx(0, abs=1e-6)
    assert misaligned(0.0) == pytest.approx(1)
    assert misaligned(math.pi / 6) == pytest.approx(0.75)  # cos(30 degrees)^2


@pytest.mark.parametrize("randomize", [pytest.param(value, marks=pytest.mark.slow) for value in (False, True)])
def test_grasps_repeat_bit_for_bit(randomize):
    def make():
        return TaskEnv(KukaGrasp(), events=EventSettings(randomize))

    dirty = make()
    lifted = 0.0
    play(dirty, 100, steer)
    for seed in range(2):
        fresh = make()
        again, _ = play(dirty, seed, steer)
        lifted = max(lifted, dirty.task.block_height)
        np.testing.assert_array_equal(again, play(fresh, seed, steer)[0], err_msg=f"seed {seed}")
        fresh.close()
    dirty.close()
    assert lifted > -0.1


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (
            {"block_x": (0.5, 0.9)},
            "block_x: 0.5 to 0.9 m is out of the hand's reach. Stay between 0.48 and 0.69, the lower value first.",
        ),
        (
            {"block_y": (0.1, 0.0)},
            "block_y: 0.1 to 0 m is out of the hand's reach. Stay between -0.2 and 0.25, the lower value first.",
        ),
    ],
)
def test_mistakes(parameters, message):
    with pytest.raises(TaskError) as caught:
        TaskEnv(KukaGrasp(**parameters))
    assert str(caught.value) == message


def test_a_reset_costs_less_than_a_step(env):
    """It loads nothing and simulates nothing."""

    def measure(function):
        started = time.process_time()
        for _ in range(50):
            function()
        return time.process_time() - started

    env.reset(seed=0)
    assert measure(env.reset) < measure(lambda: env.step(np.zeros(3)))  # a tenth of it


def test_the_attitude_is_measured_from_straight_down(env):
    observation, _ = env.reset(seed=0)
    assert observation[3:6] == pytest.approx([0, 0, 0], abs=1e-3)
    for _ in range(40):
        observation = env.step(np.array([0.0, 0.0, 1.0]))[0]
    # 40 * 0.05 rad, the same way round as the hand's turn from above, and a target that the motor is behind of
    assert observation[3:6] == pytest.approx([0, 0, env.task.gripper_yaw() - math.pi], abs=1e-3)
    assert abs(observation[5]) == pytest.approx(2.0, abs=0.2)


def test_aligned_by_hand(env):
    env.reset(seed=0)
    task, yaw = env.task, env.task.gripper_yaw() + math.pi / 2
    x, y, _ = task.gripper
    task.block.set_base((x + 0.02, y, -0.17), (0, 0, math.sin(yaw / 2), math.cos(yaw / 2)))
    # exp(-(0.02 / 0.02)^2) * (1 - 0)
    assert task.rewards(np.zeros(3, np.float32))["aligned"] == pytest.approx(math.exp(-1), abs=1e-3)
