"""A list of episodes: in order, recorded whole, the same on any number of environments."""

import numpy as np
import pytest

from rlctl.env_spec import EnvSpec
from rlctl.rollout.collect import run_episodes

pytestmark = pytest.mark.usefixtures("no_child_left")

SEEDS = [11, 3, 3, 42, 8, 5, 77, 21, 6, 1]


class TowardsZero:
    """Acts on its row alone, and remembers how many steps that row has lived."""

    def __init__(self, n_envs):
        self.steps = np.zeros(n_envs)

    def act(self, observations, rows, starts):
        assert len(observations) == len(rows) == len(starts)
        self.steps[rows[starts]] = 0
        self.steps[rows] += 1
        return np.clip(-observations - 0.01 * self.steps[rows][:, None], -1, 1).astype(np.float32)


def live(workers, **options):
    return run_episodes(workers, TowardsZero(workers.n_envs), SEEDS, **options)


@pytest.fixture(scope="module")
def expected():
    """The episodes, lived one after the other without workers."""
    from tests.rollout.conftest import ENVS

    env = EnvSpec(f"{ENVS}:Walk").make()
    episodes = []
    for seed in SEEDS:
        actor, rows = TowardsZero(1), np.array([0])
        observations, actions, rewards, done = [env.reset(seed=seed)[0]], [], [], False
        while not done:
            actions.append(actor.act(observations[-1][None], rows, np.array([not actions]))[0])
            observation, reward, done, *_ = env.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
        episodes.append((np.array(observations), np.array(actions), np.array(rewards)))
    return episodes


@pytest.mark.parametrize("n_envs", [1, 3, 8, 16])
def test_equal_on_any_number_of_environments(spec, start, expected, n_envs):
    episodes = live(start(spec("Walk"), n_envs), record=True)
    assert [episode.seed for episode in episodes] == SEEDS
    assert [episode.index for episode in episodes] == list(range(10))
    for episode, (observations, actions, rewards) in zip(episodes, expected, strict=True):
        assert episode.trajectory.observations.shape == (episode.result.length + 1, 2)
        np.testing.assert_array_equal(episode.trajectory.observations, observations)
        np.testing.assert_array_equal(episode.trajectory.actions, actions)
        np.testing.assert_array_equal(episode.trajectory.rewards, rewards)
        assert episode.result.total_reward == sum(rewards.tolist())
        assert episode.trajectory.terms.shape == (len(actions), 0)


def test_progress_is_told_and_workers_can_be_used_again(spec, start):
    workers = start(spec("Walk"), 3)
    done = []
    first = live(workers, on_episode=done.append)
    assert done == list(range(1, 11))
    assert first[0].trajectory is None
    # In the middle of other episodes: they are dropped.
    workers.reset({0: 1, 1: 2})
    again = live(workers)
    assert [a.result.total_reward for a in first] == [b.result.total_reward for b in again]


def test_no_episodes(spec, start):
    assert run_episodes(start(spec("Walk"), 2), TowardsZero(2), []) == []


def test_terms_are_recorded(spec, start):
    workers = start(EnvSpec(spec("Counting").task), 2)

    class Still:
        def act(self, observations, rows, starts):
            return np.zeros((len(rows), 1), np.float32)

    (episode,) = run_episodes(workers, Still(), [4], record=True)
    trajectory = episode.trajectory
    count = float(trajectory.observations[0, 0])
    assert trajectory.terms == pytest.approx(np.tile([count, 2.0], (4, 1)), abs=1e-6)
    # 1.0 * count + 0.5 * 2.0
    assert trajectory.rewards == pytest.approx([count + 1.0] * 4, abs=1e-6)


def test_dict_observations_are_recorded_by_key(spec, start):
    class First:
        def act(self, observations, rows, starts):
            return np.zeros(len(rows), np.int64)

    (episode,) = run_episodes(start(spec("Spaces", kind="dict"), 2), First(), [0], record=True)
    assert episode.trajectory.observations["a"].tolist() == [0, 1, 2, 3]
    assert episode.trajectory.observations["z"].shape == (4, 2)
