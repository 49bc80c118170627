"""What is worth testing of a task: a number by hand, that a goal can be reached, that it repeats."""

import numpy as np
import pytest
from my_task.touch import HEIGHT, Touch

import rlctl


@pytest.fixture
def env():
    env = rlctl.make("my_task.touch:Touch")
    env.reset(seed=0)
    yield env
    env.close()


def test_stretched_arm_ends_at_60_cm(env):
    arm = env.unwrapped.task.arm
    arm.set_joints(np.zeros(2))
    # Two links of 0.3 m along x.
    assert arm.link_position("tip") == pytest.approx([0.6, 0.0, HEIGHT], abs=1e-6)


def test_reward_terms_by_hand(env):
    task: Touch = env.unwrapped.task
    task.arm.set_joints(np.zeros(2))
    task.point = np.array([0.5, 0.0, HEIGHT])
    # The tip is at 0.6 m: 0.1 m away, more than the tolerance of 0.03 m. Action: (1 + 0) / 2.
    terms = task.rewards(np.array([1.0, 0.0]))
    assert terms == pytest.approx({"distance": 0.1, "touching": 0.0, "action": 0.5}, abs=1e-6)


def test_every_point_is_within_reach(env):
    for seed in range(50):
        env.reset(seed=seed)
        assert 0.2 <= np.linalg.norm(env.unwrapped.task.point[:2]) <= 0.5


def test_same_seed_same_episode(env):
    actions = np.random.default_rng(0).uniform(-1, 1, (10, 2)).astype(np.float32)

    def play():
        first, _ = env.reset(seed=3)
        return np.stack([first, *(env.step(action)[0] for action in actions)])

    assert np.array_equal(play(), play())
