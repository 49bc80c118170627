"""The five classics are those of pybullet-envs-gymnasium: the same start, observations, rewards and flags, bit for bit.

The reference's first episode is left out: its floor joins the mean of the body parts' places only after the reset. All
its later episodes, which is what a training sees, are the family's.
"""

import gymnasium
import numpy as np
import pytest

from rlctl.task.env import TaskEnv
from rlctl_locomotion.robots import Ant, HalfCheetah, Hopper, Humanoid, Walker2D

pytest.importorskip("pybullet", reason="PyBullet is not installed")
pytest.importorskip("pybullet_envs_gymnasium")  # registers the reference

ROBOTS = [Ant, HalfCheetah, Hopper, Walker2D, Humanoid]
STEPS = 1000
FEWER = 300  # most have fallen several times by then
SEEDS = [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]


def reference(robot):
    env = gymnasium.make(f"{robot.__name__}BulletEnv-v0", disable_env_checker=True)
    env.reset(seed=123)
    return env


@pytest.fixture(params=ROBOTS, ids=lambda robot: robot.__name__)
def pair(request):
    ours, theirs = TaskEnv(request.param()), reference(request.param)
    yield ours, theirs
    ours.close()
    theirs.close()


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "steps"), [(0, FEWER), *((seed, STEPS) for seed in range(3))])
def test_many_steps_and_the_episodes_in_them(pair, seed, steps):
    ours, theirs = pair
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, *ours.action_space.shape)).astype(np.float32)
    np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
    for step, action in enumerate(actions):
        observation, reward, *flags, _ = ours.step(action)
        expected, expected_reward, *expected_flags, _ = theirs.step(action)
        np.testing.assert_array_equal(observation, expected, err_msg=f"step {step}")
        assert (reward, flags) == (expected_reward, expected_flags), step
        if any(flags):
            # The next start is drawn from where the generator is now.
            np.testing.assert_array_equal(ours.reset()[0], theirs.reset()[0])


@pytest.mark.slow
@pytest.mark.parametrize("robot", [Hopper, Walker2D, Humanoid])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_thousand_steps_without_a_new_start(robot, seed):
    """With random actions they fall in a second; what happens on the floor is long and full of contacts."""

    class Fallen(robot):
        def is_terminated(self):
            return False

    ours, theirs = TaskEnv(Fallen()), reference(robot)
    actions = np.random.default_rng(seed).uniform(-1, 1, (STEPS, *ours.action_space.shape)).astype(np.float32)
    np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
    fallen = 0
    for step, action in enumerate(actions, start=1):
        observation, reward, _, truncated, _ = ours.step(action)
        expected, expected_reward, terminated, expected_truncated, _ = theirs.step(action)
        np.testing.assert_array_equal(observation, expected, err_msg=f"step {step}")
        assert (reward, ours.task.alive() < 0) == (expected_reward, terminated), step
        assert truncated == expected_truncated == (step == STEPS)
        fallen += terminated
    assert fallen > STEPS / 2
    ours.close()
    theirs.close()


def test_the_spaces(pair):
    ours, theirs = pair
    sizes = {"Ant": (28, 8), "HalfCheetah": (26, 6), "Hopper": (15, 3), "Walker2D": (22, 6), "Humanoid": (44, 17)}
    assert ours.action_space == theirs.action_space
    assert ours.observation_space == theirs.observation_space
    assert ours.observation_space.shape + ours.action_space.shape == sizes[ours.name]


def test_the_first_episode_of_a_reference_instance_is_another_one():
    env = gymnasium.make("Walker2DBulletEnv-v0", disable_env_checker=True)
    rewards = []
    for _ in range(3):
        env.reset(seed=0)
        rewards.append(env.step(np.zeros(6, np.float32))[1])
    env.close()
    ours = TaskEnv(Walker2D())
    ours.reset(seed=0)
    assert rewards[1] == rewards[2] == ours.step(np.zeros(6, np.float32))[1]
    assert abs(rewards[0] - rewards[1]) > 1e-3
    ours.close()
