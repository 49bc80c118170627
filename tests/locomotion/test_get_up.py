"""Get up: how episodes begin, the limp time, and what standing still is."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl_locomotion.get_up import LIMP_S, STILL_S

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def env():
    with closing(EnvSpec("get-up").make()) as made:
        yield made


@pytest.fixture
def task(env):
    return env.unwrapped.task


def test_it_lies_just_above_the_ground_with_joints_within_their_limits(env, task):
    tilts = []
    for seed in range(20):
        env.reset(seed=seed)
        assert task.find_lowest() == pytest.approx(0.0, abs=1e-6)
        joints = task.body.joint_positions[0]
        assert ((task.low <= joints) & (joints <= task.high)).all()
        task.measure()
        tilts.append(float(task.gravity[0, 2]))
    assert min(tilts) < -0.8  # on its belly
    assert max(tilts) > 0.8  # on its back


def test_actions_do_nothing_while_it_is_limp(env, task):
    limp_steps = round(LIMP_S / task.control_dt)
    joints = []
    for action in (np.zeros(12, np.float32), np.ones(12, np.float32)):
        env.reset(seed=1)
        for _ in range(limp_steps):
            env.step(action)
        limp = task.body.joint_positions
        env.step(action)
        joints.append((limp, task.body.joint_positions))
    assert (joints[0][0] == joints[1][0]).all()
    assert (joints[0][1] != joints[1][1]).any()


def test_success_is_standing_still_in_the_stance_for_half_a_second(env, task):
    env.reset(seed=0)
    task.steps[:] = 100  # the limp time is over
    task.body.set_base([[0.0, 0.0, task.start_height]])
    task.body.set_joints(task.stance[None])
    stood = []
    for _ in range(60):
        info = env.step(np.zeros(12, np.float32))[-1]
        stood.append((float(task.still[0]) * task.control_dt, info["is_success"]))
    assert all(success == (still >= STILL_S) for still, success in stood)
    assert stood[-1][1]
    env.step(np.full(12, 4.0, np.float32))
    for _ in range(3):
        info = env.step(np.full(12, 4.0, np.float32))[-1]
    assert task.still[0] == 0
    assert not info["is_success"]
