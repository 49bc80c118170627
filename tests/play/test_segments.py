"""Segments that workers play by themselves: the same however environments are spread, every episode by its address."""

import numpy as np
import pytest

from rlctl.errors import EpisodeFailed
from rlctl.play.messages import Play
from rlctl.play.seeds import Stream, episode_seed
from rlctl.policy.actor import Exploration, Rows, as_rows
from rlctl.policy.numpy_actor import NumpyActor
from tests.play.policies import linear

pytestmark = pytest.mark.usefixtures("no_child_left")

SAMPLES = Exploration(stochastic=True)
WEIGHT = -0.1 * np.eye(2)


def seed(env: int, episode: int) -> int:
    return episode_seed(3, Stream.TRAIN, env, episode)


def play(workers, segments, steps):
    """Return copies of the arrays of some segments, joined, and the episodes that ended."""
    workers.set_policy(linear(workers.info, WEIGHT, log_std=-1.0))
    started, results, parts = [1] * workers.n_envs, [], []
    for number in range(segments):
        begin = {env: -1 if number else seed(env, 0) for env in range(workers.n_envs)}
        workers.start_playing(Play(steps, begin, dict(enumerate(started)), run_seed=3, exploration=SAMPLES))
        ended = workers.finish_playing()
        for each in ended:
            started[each.env] += 1
        results += [(number * steps + each.row, each) for each in ended]
        segment = workers.arrays.segment
        names = ("stored", "action", "reward", "terminated")
        parts.append({name: getattr(segment, name)[:, :steps].copy() for name in names})
        parts[-1]["observation"] = segment.observation[""][:, :steps].copy()
    joined = {name: np.concatenate([part[name] for part in parts], axis=1) for name in parts[0]}
    return joined, sorted(results, key=lambda pair: (pair[1].env, pair[0]))


@pytest.mark.slow_except("3")
@pytest.mark.parametrize("n_workers", [2, 3])
def test_equal_however_environments_and_steps_are_spread(spec, start, n_workers):
    """Five environments on two or three workers, four segments of 10 steps, against one worker and one segment."""
    one, ended = play(start(spec("Walk"), 5, n_workers=1), 1, 40)
    other, also = play(start(spec("Walk"), 5, n_workers=n_workers), 4, 10)
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)
    assert [(row, each) for row, each in ended] == [(row, each) for row, each in also]
    assert len(ended) > 10


def test_workers_play_as_this_process_does(spec, start):
    workers = start(spec("Walk"), 2)
    played, ended = play(workers, 1, 30)
    env, actor = spec("Walk").make(), NumpyActor(linear(workers.info, WEIGHT, log_std=-1.0))
    actor.explore(SAMPLES)
    results = [(row, each) for row, each in ended if each.env == 1]
    episode, step, total = 0, 0, 0.0
    observation, _ = env.reset(seed=seed(1, 0))
    for row in range(30):
        np.testing.assert_array_equal(played["observation"][1, row], observation)
        (stored,), (action,) = actor.act(as_rows(observation), Rows.one(seed(1, episode), step))
        np.testing.assert_array_equal(played["stored"][1, row], stored)
        np.testing.assert_array_equal(played["action"][1, row], np.clip(stored, -1, 1))
        observation, reward, done, _, info = env.step(action)
        assert (played["reward"][1, row], played["terminated"][1, row]) == (reward, done)
        step, total = step + 1, total + reward
        if done:
            ended_in, result = results[episode]
            assert (ended_in, result.seed, result.total_reward, result.length) == (row, seed(1, episode), total, step)
            assert (result.success, result.final_distance) == (info["is_success"], info["distance"])
            np.testing.assert_array_equal(workers.arrays.segment.final[""][1, row], observation)
            episode, step, total = episode + 1, 0, 0.0
            observation, _ = env.reset(seed=seed(1, episode))
    assert len(results) == episode > 1


def test_episodes_of_one_step(spec, start):
    workers = start(spec("Long", length=1), 3, n_workers=2)
    played, ended = play(workers, 2, 5)
    assert played["terminated"].all()
    assert [each.seed for _, each in ended] == [seed(env, number) for env in range(3) for number in range(10)]
    assert {each.length for _, each in ended} == {1}
    # Each ended at the observation 1, and what follows is the next one's first.
    assert (workers.arrays.segment.final[""][:, :5] == 1.0).all()
    assert (played["observation"] == 0.0).all()


def test_an_environment_stops_where_its_episode_ends_without_a_next_one(spec, start):
    workers = start(spec("Walk"), 2, n_workers=1)
    workers.set_policy(linear(workers.info, WEIGHT))
    workers.start_playing(Play(60, {0: 1, 1: 2}, {1: 5}, run_seed=3))
    ended = workers.finish_playing()
    assert [each.seed for each in ended if each.env == 0] == [1]
    assert [each.seed for each in ended if each.env == 1][:3] == [2, seed(1, 5), seed(1, 6)]
    last = workers.arrays.segment.observation[""][0, ended[0].row + 1]
    np.testing.assert_array_equal(workers.observations([0])[0], last)


def test_uniform_actions_of_a_warm_up(spec, start):
    workers = start(spec("Spaces", kind="discrete"), 2)
    workers.set_policy(linear(workers.info, np.zeros((2, 7))))
    workers.start_playing(Play(40, {0: 1, 1: 2}, {0: 1, 1: 1}, run_seed=3, exploration=Exploration(warmup=True)))
    workers.finish_playing()
    assert set(workers.arrays.segment.action[:, :40].ravel().tolist()) == {0, 1}


def test_the_step_of_a_segment_that_fails_is_named(spec, start):
    workers = start(spec("Walk", fault="raise"), 3, n_workers=2)
    workers.set_policy(linear(workers.info, WEIGHT))
    workers.start_playing(Play(20, {0: 5, 1: 6, 2: 7}, {0: 1, 1: 1, 2: 1}, run_seed=3))
    with pytest.raises(EpisodeFailed) as caught:
        workers.finish_playing()
    assert (caught.value.env, caught.value.seed, caught.value.step) == (2, 7, 3)
    assert workers.arrays.inside[2].tolist() == [7, 3, 2]
