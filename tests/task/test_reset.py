"""A reset forgets everything: equal seeds and actions give equal bits, whatever was simulated before."""

import numpy as np
import pytest

from rlctl.task.env import TaskEnv
from rlctl.task.pybullet.library import pybullet
from rlctl_manipulation.reach import Reach
from tests.task.tasks import Cubes, Pile, PileAnew

pytestmark = pytest.mark.pybullet

SEEDS = range(10)


def play(env, seed, actions):
    """Observations and rewards of an episode, shape (T + 1, ...)."""
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    for action in actions:
        observation, reward, *_ = env.step(action)
        rows.append(np.append(observation, reward))
    return np.array(rows)


def contacts(env):
    return len(pybullet.getContactPoints(physicsClientId=env.sim.client))


def push_into_the_plane(env, seed):
    """Drive the arm down and along the plane; return how many contacts were seen."""
    rng = np.random.default_rng(seed)
    env.reset(seed=1000 + seed)
    seen = 0
    for _ in range(env.max_steps):
        down = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0])
        *_, truncated, _ = env.step(down + rng.uniform(-0.5, 0.5, 7))
        seen += contacts(env)
        if truncated:
            break
    return seen


@pytest.mark.slow
def test_reach_after_many_contacts():
    actions = np.random.default_rng(0).uniform(-1, 1, (TaskEnv(Reach()).max_steps, 7))
    # Half of the seeds run into the plane themselves.
    down = np.clip(actions + np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0]), -1, 1)
    dirty = TaskEnv(Reach())
    for seed in SEEDS:
        assert push_into_the_plane(dirty, seed) > 20
        fresh = TaskEnv(Reach())
        chosen = down if seed % 2 else actions
        np.testing.assert_array_equal(play(dirty, seed, chosen), play(fresh, seed, chosen), err_msg=f"seed {seed}")
        fresh.close()
    dirty.close()


def test_contacts_of_the_last_episode_are_gone():
    """PyBullet's restored worlds keep contacts that the saved one does not have, and let them act in the next step."""
    env = TaskEnv(Reach())
    env.reset(seed=0)
    while not contacts(env):
        env.step(np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0]))
    env.reset(seed=1)
    assert contacts(env) == 0
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        Cubes,  # exact by the parameter deterministicOverlappingPairs alone
        pytest.param(PileAnew),
        # Why there is `fast_reset = False`. The day this passes, a fast reset does for every task.
        pytest.param(Pile, marks=pytest.mark.xfail(strict=True, reason="restored contacts come in another order")),
    ],
)
def test_a_pile_of_free_bodies(task):
    dirty = TaskEnv(task())
    steps = np.zeros((150, 1))
    for seed in range(6):
        play(dirty, 1000 + seed, steps)
        assert contacts(dirty) >= 5
        fresh = TaskEnv(task())
        np.testing.assert_array_equal(play(dirty, seed, steps), play(fresh, seed, steps), err_msg=f"seed {seed}")
        fresh.close()
    dirty.close()


def test_a_full_reset_loads_the_world_anew():
    env = TaskEnv(PileAnew())
    before = env.task.pieces[0]
    env.reset(seed=0)
    assert env.task.pieces[0] is not before
    assert pybullet.getNumBodies(physicsClientId=env.sim.client) == 13
    env.close()


def test_seeds_differ_and_the_next_episode_goes_on_from_them():
    env = TaskEnv(Reach())
    one, two = env.reset(seed=1)[0], env.reset(seed=2)[0]
    assert not np.array_equal(one, two)
    after_two = env.reset()[0]
    assert not np.array_equal(after_two, two)
    env.reset(seed=2)
    np.testing.assert_array_equal(env.reset()[0], after_two)
    env.close()


def test_environments_side_by_side_are_as_alone():
    actions = np.random.default_rng(3).uniform(-1, 1, (60, 7))
    alone = TaskEnv(Reach())
    expected = [play(alone, seed, actions) for seed in (1, 2)]
    alone.close()
    envs = [TaskEnv(Reach()), TaskEnv(Reach())]
    rows = [[np.append(env.reset(seed=seed)[0], 0.0)] for seed, env in enumerate(envs, start=1)]
    for action in actions:
        for env, seen in zip(envs, rows, strict=True):
            observation, reward, *_ = env.step(action)
            seen.append(np.append(observation, reward))
    for seen, known in zip(rows, expected, strict=True):
        np.testing.assert_array_equal(np.array(seen), known)
    envs[0].close()
    envs[0].close()  # again: nothing happens
    np.testing.assert_array_equal(play(envs[1], 2, actions), expected[1])
    envs[1].close()
