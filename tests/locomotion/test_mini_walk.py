"""The robot with hobby servos: its model, its motors, and what differs from one robot to the next."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.task.named_motors import find_motor
from rlctl_locomotion.mini_walk import JOINTS

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def env():
    with closing(EnvSpec("mini-walk").make()) as made:
        yield made


@pytest.fixture
def task(env):
    return env.unwrapped.task


def test_the_model(task):
    # Trunk 0.15 + 0.31, each leg 3 x 0.07 + 2 x 0.09 + 0.06, neck and head 0.07 + 0.12 kg.
    assert task.body.total_mass() == pytest.approx(0.46 + 2 * 0.45 + 0.19)
    assert task.body.joint_names == JOINTS
    assert ((task.body.joint_low <= task.stance) & (task.stance <= task.body.joint_high)).all()


def test_its_motors_are_servos(task):
    joints, servo = task.describe_joints(), find_motor("sts3215")
    assert task.body.joint_max_force == pytest.approx(servo.stall_torque_nm)
    assert list(joints.stiffness) == pytest.approx([servo.stiffness_nm_per_rad] * 14)


def test_it_starts_on_its_feet_and_must_lift_one(env, task):
    env.reset(seed=0)
    assert (task.measure_feet() > 0.0).all()
    assert (task.measure_feet() < 0.02).all()
    steps = 1
    while not env.step(np.zeros(14, np.float32))[2]:
        steps += 1
    # Wanted is more than 90 % of the swing from asin(0.9) / (2 pi) of the period on: 0.08 s, the fifth step.
    assert steps == 5
    assert task.measure_height() == pytest.approx(task.target_height, abs=0.005)
    assert task.fallen


def test_what_a_joint_draws_is_mirrored_to_the_same_joint_of_the_other_side(task):
    other = {"left": "right", "right": "left"}
    sides = [name.split("_", 1) for name in JOINTS]
    expected = [f"{other.get(side, side)}_{joint}" for side, joint in sides]
    for name in ("motor_bias", "torque_constant", "motor_friction"):
        places = np.abs(task.mirror[f"events/{name}"]) - 1
        assert [JOINTS[place] for place in places] == expected
    assert min(task.mirror["events/motor_friction"]) > 0  # friction has no direction


@pytest.mark.slow
def test_every_robot_that_the_recipe_draws_stands():
    """A policy that holds the stance does not fall, whatever the servos, the battery and the ground are."""
    with closing(EnvSpec("mini-walk", {"must_step": False}, randomize=True).make()) as env:
        for seed in range(10):
            env.reset(seed=seed)
            fallen = [env.step(np.zeros(14, np.float32))[2] for _ in range(150)]  # 3 s: before the first push
            assert not any(fallen)
