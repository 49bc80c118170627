"""The humanoid: its model, its clock, and the feet that follow it."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl_locomotion.humanoid_walk import JOINTS

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def env():
    with closing(EnvSpec("humanoid-walk").make()) as made:
        yield made


@pytest.fixture
def task(env):
    return env.unwrapped.task


def test_the_model(task):
    # Trunk 11, each leg 0.5 + 0.5 + 2.5 + 1.8 + 0.2 + 0.6 = 6.1, each arm 0.8 + 0.6 = 1.4 kg.
    assert task.body.total_mass() == pytest.approx(11 + 2 * 6.1 + 2 * 1.4)
    assert task.body.joint_names == JOINTS
    assert ((task.body.joint_low <= task.stance) & (task.stance <= task.body.joint_high)).all()
    assert (task.body.joint_max_force > 0).all()


def test_it_starts_on_its_feet_and_must_lift_one(env, task):
    env.reset(seed=0)
    assert (task.measure_feet() > 0.0).all()
    assert (task.measure_feet() < 0.04).all()
    steps = 1
    while not env.step(np.zeros(16, np.float32))[2]:
        steps += 1
    # Wanted is more than 90 % of the swing from asin(0.9) / (2 pi) of the period on: 0.125 s, the seventh step.
    assert steps == 7
    assert task.measure_height() == pytest.approx(task.target_height, abs=0.03)
    assert task.fallen


def test_the_clock(env, task):
    firsts = set()
    for seed in range(6):
        env.reset(seed=seed)
        firsts.add(tuple(task.phase[0]))
    assert firsts == {(0.0, 1.0), (0.0, -1.0)}  # about to lift the left or the right foot
    first = task.phase[0].copy()
    for _ in range(round(task.period_s / task.control_dt)):
        task.act(np.zeros((1, 16)))
    np.testing.assert_allclose(task.phase[0], first, atol=1e-9)


def test_a_foot_is_wanted_in_the_air_while_the_clock_says_so(env, task):
    env.reset(seed=0)
    action = np.zeros((1, 16))
    task.phase[:] = (1.0, 0.0)  # the left foot is at its highest
    task.measure()
    task.foot_heights[:] = (task.swing, 0.0)
    assert task.rewards(action)["gait"] == pytest.approx(1.0)
    task.phase[:] = (-1.0, 0.0)
    task.measure()
    task.foot_heights[:] = (task.swing, 0.0)
    # Both feet are as far off as they are lifted.
    assert task.rewards(action)["gait"] == pytest.approx(0.0)
