"""A list of episodes: in order, recorded whole, the same on any number of environments."""

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import DivergedError, EpisodeFailed, TaskError
from rlctl.play import collect
from rlctl.play.collect import play_episodes
from rlctl.policy.actor import Exploration
from tests.play.policies import linear

pytestmark = pytest.mark.usefixtures("no_child_left")

SEEDS = [11, 3, 3, 42, 8, 5, 77, 21, 6, 1]


TOWARDS_ZERO = -0.5 * np.eye(2)


def play(workers, **options):
    workers.set_policy(linear(workers.info, TOWARDS_ZERO))
    return play_episodes(workers, SEEDS, **options)


@pytest.fixture(scope="module")
def expected():
    """The episodes, played one after the other without workers."""
    from tests.play.conftest import ENVS

    env = EnvSpec(f"{ENVS}:Walk").make()
    episodes = []
    for seed in SEEDS:
        observations, actions, rewards, done = [env.reset(seed=seed)[0]], [], [], False
        while not done:
            actions.append(np.clip(TOWARDS_ZERO.astype(np.float32) @ observations[-1], -1, 1))
            observation, reward, done, *_ = env.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
        episodes.append((np.array(observations), np.array(actions), np.array(rewards)))
    return episodes


@pytest.mark.slow_except("3")
@pytest.mark.parametrize("n_envs", [1, 3, 8, 16])
def test_equal_on_any_number_of_environments(spec, start, expected, n_envs):
    episodes = play(start(spec("Walk"), n_envs), record=True)
    assert [episode.result.seed for episode in episodes] == SEEDS
    for episode, (observations, actions, rewards) in zip(episodes, expected, strict=True):
        assert episode.trajectory.observations.shape == (episode.result.length + 1, 2)
        np.testing.assert_array_equal(episode.trajectory.observations, observations)
        np.testing.assert_array_equal(episode.trajectory.actions, actions)
        np.testing.assert_array_equal(episode.trajectory.rewards, rewards)
        assert episode.result.total_reward == sum(rewards.tolist())
        assert episode.trajectory.terms.shape == (len(actions), 0)


def test_progress_is_reported_and_workers_can_be_used_again(spec, start):
    workers = start(spec("Walk"), 3)
    done = []
    first = play(workers, watch=done.append)
    assert done == sorted(done)
    assert done[-1] == 10
    assert first[0].trajectory is None
    # In the middle of other episodes: they are dropped.
    workers.reset({0: 1, 1: 2})
    again = play(workers)
    assert [a.result.total_reward for a in first] == [b.result.total_reward for b in again]


def test_no_episodes(spec, start):
    assert play_episodes(start(spec("Walk"), 2), []) == []


def test_terms_are_recorded(spec, start):
    workers = start(EnvSpec(spec("Counting").task), 2)
    workers.set_policy(linear(workers.info, [[0.0]]))
    (episode,) = play_episodes(workers, [4], record=True)
    trajectory = episode.trajectory
    count = float(trajectory.observations[0, 0])
    assert trajectory.terms == pytest.approx(np.tile([count, 2.0], (4, 1)), abs=1e-6)
    # 1.0 * count + 0.5 * 2.0
    assert trajectory.rewards == pytest.approx([count + 1.0] * 4, abs=1e-6)


@pytest.mark.slow
@pytest.mark.pybullet
def test_overlapping_bodies_are_measured_in_the_first_episodes(spec, start):
    workers = start(EnvSpec(spec("Sunk").task), 2)
    workers.set_policy(linear(workers.info, np.zeros((1, 3))))
    episodes = play_episodes(workers, range(11), record=True)
    # The cube begins 2 cm inside the floor, and each step lets it out a little.
    assert all(0.01 < each.result.deepest_contact < 0.02 for each in episodes[:10])
    assert episodes[10].result.deepest_contact is None
    assert play_episodes(workers, [0])[0].result.deepest_contact is None


def test_dict_observations_are_recorded_by_key(spec, start):
    workers = start(spec("Spaces", kind="dict"), 2)
    workers.set_policy(linear(workers.info, np.zeros((4, 7))))  # two numbers and five alternatives
    (episode,) = play_episodes(workers, [0], record=True)
    assert episode.trajectory.observations["a"].tolist() == [0, 1, 2, 3]
    assert episode.trajectory.observations["z"].shape == (4, 2)
    assert episode.trajectory.actions.tolist() == [0, 0, 0]


def test_an_episode_longer_than_a_segment_is_recorded_whole(spec, start):
    """Without a time limit an environment is played in segments, and they are joined."""
    workers = start(spec("Long", length=2345), 2)
    workers.set_policy(linear(workers.info, TOWARDS_ZERO))
    (episode,) = play_episodes(workers, [4], record=True)
    assert episode.result.length == len(episode.trajectory.actions) == 2345
    assert episode.trajectory.observations[:, 0].tolist() == list(range(2346))


@pytest.mark.slow
def test_an_episode_that_never_ends(spec, start, monkeypatch):
    monkeypatch.setattr(collect, "MOST_STEPS", 2000)
    workers = start(spec("Long", length=0), 1)
    workers.set_policy(linear(workers.info, TOWARDS_ZERO))
    with pytest.raises(TaskError, match=r"the episode of seed 4 has not ended within 2,000 steps, and no time limit"):
        play_episodes(workers, [4])


def test_samples_follow_from_the_episode_and_the_step(spec, start):
    """With one worker or three, in any order, and not equal from step to step."""
    explore = Exploration(stochastic=True)
    actions = []
    for n_envs in (1, 3):
        workers = start(spec("Walk"), n_envs, n_workers=n_envs)
        workers.set_policy(linear(workers.info, 0.01 * TOWARDS_ZERO, log_std=-3.0))
        episodes = play_episodes(workers, SEEDS, explore, record=True)
        actions.append([episode.trajectory.actions for episode in episodes])
    for one, three in zip(*actions, strict=True):
        np.testing.assert_array_equal(one, three)
        assert len(np.unique(one[:, 0])) == len(one)
    np.testing.assert_array_equal(actions[0][1], actions[0][2])  # one seed, one episode
    assert not np.array_equal(actions[0][0][:5], actions[0][3][:5])


def test_leaving_while_episodes_are_played(spec, start):
    def leave(done):
        raise InterruptedError

    workers = start(spec("Walk"), 2)
    workers.set_policy(linear(workers.info, TOWARDS_ZERO))
    with pytest.raises(InterruptedError):
        play_episodes(workers, SEEDS, watch=leave)


def test_the_actions_of_an_episode_that_fails_are_known(spec, start):
    """Also where the worker dies: actions are in shared memory before the step is taken."""
    for fault in ("raise", "segfault"):
        workers = start(spec("Walk", fault=fault), 2)
        workers.set_policy(linear(workers.info, TOWARDS_ZERO))
        with pytest.raises(EpisodeFailed) as caught:
            play_episodes(workers, [7], record=True)
        assert (caught.value.seed, caught.value.step, caught.value.actions.shape) == (7, 3, (3, 2))


def test_a_policy_that_overflows_is_named_with_its_episode(spec, start):
    workers = start(spec("Walk"), 2)
    workers.set_policy(linear(workers.info, 3e38 * np.ones((2, 2))))
    with pytest.raises(
        DivergedError, match=r"the policy's action is not finite: \[.*\]\nin environment 0, episode seed 3"
    ):
        play_episodes(workers, [3])
