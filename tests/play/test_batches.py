"""The worlds of a task in batches in worker processes: the same segments however they are spread."""

import dataclasses

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import DivergedError, EpisodeFailed, PolicyError
from rlctl.play.collect import play_episodes
from rlctl.play.messages import Play
from rlctl.play.seeds import Stream, episode_seed
from rlctl.policy.actor import Exploration, Rows, as_rows
from rlctl.policy.file import PolicyFile
from rlctl.policy.numpy_actor import NumpyActor
from tests.play.policies import linear

pytest.importorskip("mujoco")
pytestmark = pytest.mark.usefixtures("no_child_left")

STOOL = "tests.task.batches:Stool"
SAMPLES = Exploration(stochastic=True)
WEIGHT = 1.5 * np.random.default_rng(0).standard_normal((2, 14))
NAMES = ("stored", "action", "reward", "terminated", "truncated")


@pytest.fixture
def spec():
    return EnvSpec(STOOL, randomize=True)


def seed(env: int, episode: int) -> int:
    return episode_seed(3, Stream.TRAIN, env, episode)


def play(workers, segments, steps, policy=None):
    """Return copies of the arrays of some segments, joined, and the episodes that ended."""
    workers.set_policy(policy or linear(workers.info, WEIGHT, log_std=-1.0))
    started, results, parts = [1] * workers.n_envs, [], []
    for number in range(segments):
        begin = {env: -1 if number else seed(env, 0) for env in range(workers.n_envs)}
        workers.start_playing(Play(steps, begin, dict(enumerate(started)), run_seed=3, exploration=SAMPLES))
        ended = workers.finish_playing()
        for episode in ended:
            started[episode.env] += 1
        results += [(number * steps + episode.row, episode) for episode in ended]
        segment = workers.arrays.segment
        parts.append({name: getattr(segment, name)[:, :steps].copy() for name in NAMES})
        parts[-1]["observation"] = segment.observation[""][:, :steps].copy()
    joined = {name: np.concatenate([part[name] for part in parts], axis=1) for name in parts[0]}
    return joined, sorted(results, key=lambda pair: (pair[1].env, pair[0]))


@pytest.mark.slow_except("2")
@pytest.mark.parametrize("n_workers", [2, 3])
def test_equal_however_worlds_and_steps_are_spread(spec, start, n_workers):
    one, ended = play(start(spec, 6, n_workers=1), 1, 60)
    other, also = play(start(spec, 6, n_workers=n_workers), 4, 15)
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)
    assert ended == also
    assert len({row for row, _ in ended}) > 4  # episodes begin at different times


@pytest.mark.slow
def test_workers_play_as_one_world_does(spec, start):
    workers = start(spec, 4, n_workers=1)
    played, ended = play(workers, 1, 40)
    env, actor = spec.make(), NumpyActor(linear(workers.info, WEIGHT, log_std=-1.0))
    actor.explore(SAMPLES)
    results = [(row, result) for row, result in ended if result.env == 1]
    episode, step, total = 0, 0, 0.0
    observation, _ = env.reset(seed=seed(1, 0))
    for row in range(40):
        np.testing.assert_array_equal(played["observation"][1, row], observation)
        (stored,), _ = actor.act(as_rows(observation), Rows.one(seed(1, episode), step))
        np.testing.assert_array_equal(played["stored"][1, row], stored)
        observation, reward, terminated, truncated, info = env.step(played["action"][1, row])
        assert played["reward"][1, row] == reward
        step, total = step + 1, total + reward
        if terminated or truncated:
            ended_in, result = results[episode]
            assert (ended_in, result.seed, result.length) == (row, seed(1, episode), step)
            assert (result.success, result.total_reward) == (info["is_success"], pytest.approx(total))
            assert result.metrics.keys() == {"time"}
            np.testing.assert_array_equal(workers.arrays.segment.final[""][1, row], observation)
            episode, step, total = episode + 1, 0, 0.0
            observation, _ = env.reset(seed=seed(1, episode))
    assert len(results) == episode >= 1


@pytest.mark.slow
def test_whole_episodes_and_their_contacts(spec, start):
    seeds = list(range(7))
    one, several = start(spec, 1), start(spec, 5, n_workers=2)
    episodes = []
    for workers in (one, several):
        workers.set_policy(linear(workers.info, WEIGHT, log_std=-1.0))
        episodes.append(play_episodes(workers, seeds, SAMPLES, record=True))
    for alone, among in zip(*episodes, strict=True):
        assert alone.result.deepest_contact == pytest.approx(among.result.deepest_contact, abs=1e-9)
        assert 0 < alone.result.deepest_contact < 0.05
        assert dataclasses.replace(alone.result, env=0, deepest_contact=None) == dataclasses.replace(
            among.result, env=0, deepest_contact=None
        )
        np.testing.assert_array_equal(alone.trajectory.observations, among.trajectory.observations)
        np.testing.assert_array_equal(alone.trajectory.actions, among.trajectory.actions)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random", "zero"])
def test_other_policies_play_in_every_world(spec, start, name):
    seeds, episodes = list(range(6)), []
    for workers in (start(spec, 1), start(spec, 6, n_workers=2)):
        workers.set_other_policy(name)
        episodes.append(play_episodes(workers, seeds, record=True))
    for alone, among in zip(*episodes, strict=True):
        np.testing.assert_array_equal(alone.trajectory.actions, among.trajectory.actions)
        np.testing.assert_array_equal(alone.trajectory.observations, among.trajectory.observations)


def test_a_function_plays_and_its_failure_is_that_of_its_world(spec, start, write_module):
    file = write_module("own.py", "def lean(observation):\n    return [0.5, -0.5 if observation[0] else 0.0]\n")
    workers = start(spec, 3, n_workers=1)
    workers.set_other_policy(f"{file}:lean")
    episodes = play_episodes(workers, [1, 2, 3], record=True)
    assert all((episode.trajectory.actions == (0.5, -0.5)).all() for episode in episodes)
    file = write_module("bad.py", "def lean(observation):\n    return 1 / 0\n")
    workers.set_other_policy(f"{file}:lean")
    with pytest.raises(PolicyError, match="in environment 0, episode seed 1, step 0"):
        play_episodes(workers, [1, 2, 3])


@pytest.mark.slow
def test_recurrent_states_are_those_of_the_environments(spec, start, recurrent):
    """The main process reads and writes them between segments."""
    one, other = start(spec, 4, n_workers=1), start(spec, 4, n_workers=2)
    policy = recurrent(one.info)
    states = []
    for workers in (one, other):
        play(workers, 1, 20, policy)
        states.append(workers.recurrent_state.copy())
        assert np.abs(states[-1]).min(axis=(1, 2, 3)).all()
    np.testing.assert_array_equal(*states)
    begin = dict.fromkeys(range(4), -1)
    one.recurrent_state[:] = other.recurrent_state[:] = 0.25
    for workers in (one, other):
        workers.start_playing(Play(1, begin, dict.fromkeys(range(4), 1), run_seed=3))
        workers.finish_playing()
    np.testing.assert_array_equal(one.arrays.segment.stored[:, 0], other.arrays.segment.stored[:, 0])
    assert (one.recurrent_state != 0.25).all()


@pytest.fixture
def recurrent():
    """Return an untrained policy with an LSTM."""

    def make(info) -> PolicyFile:
        rng = np.random.default_rng(0)
        size = 4
        shapes = {
            "lstm_actor.weight_ih_l0": (4 * size, 14),
            "lstm_actor.weight_hh_l0": (4 * size, size),
            "lstm_actor.bias_ih_l0": (4 * size,),
            "lstm_actor.bias_hh_l0": (4 * size,),
            "action_net.weight": (2, size),
            "action_net.bias": (2,),
        }
        policy = linear(info, WEIGHT, log_std=-1.0)
        tensors = {f"policy/{name}": rng.normal(0, 0.5, shape).astype(np.float32) for name, shape in shapes.items()}
        return PolicyFile(policy.info.model_copy(update={"algo": "recurrent_ppo"}), {**policy.tensors, **tensors})

    return make


@pytest.mark.slow
def test_a_value_that_is_not_finite_is_that_of_an_episode(start):
    spec = EnvSpec(STOOL, {"fault": "reward", "faulty_start": 0.285})
    workers = start(spec, 6, n_workers=2)
    with pytest.raises(EpisodeFailed) as caught:
        play(workers, 3, 40)
    error = caught.value
    assert error.step == 3
    assert error.seed in {seed(error.env, episode) for episode in range(10)}
    alone = spec.make()
    alone.reset(seed=error.seed)
    assert alone.unwrapped.task.goal[0] > 0.285
    assert str(error).startswith(
        f"task {STOOL!r}: Stool: reward term 'height' is nan at step 3\nin environment {error.env}, episode "
    )


@pytest.mark.slow
def test_an_action_that_is_not_finite_is_that_of_an_episode(spec, start):
    workers = start(spec, 2, n_workers=1)
    with pytest.raises(DivergedError, match=r"the policy's action is not finite.*\nin environment 0, episode seed"):
        play(workers, 1, 4, linear(workers.info, WEIGHT, log_std=-1.0, bias=np.nan))


@pytest.mark.slow
def test_actions_are_replayed(spec, start):
    """Worlds with fewer recorded actions wait for the others."""
    first, again = start(spec, 4, n_workers=1), start(spec, 4, n_workers=2)
    played, _ = play(first, 1, 10)
    lengths = [3, 9, 0, 6]
    left = again.begin_episodes(
        {env: (seed(env, 0), played["action"][env, :count]) for env, count in enumerate(lengths)}
    )
    assert left == set()
    for env, count in enumerate(lengths):
        np.testing.assert_array_equal(again.observations()[env], played["observation"][env, count])
    again.set_policy(linear(again.info, WEIGHT, log_std=-1.0))
    again.start_playing(
        Play(1, dict.fromkeys(range(4), -1), dict.fromkeys(range(4), 1), run_seed=3, exploration=SAMPLES)
    )
    again.finish_playing()
    for env, count in enumerate(lengths):
        np.testing.assert_array_equal(again.arrays.segment.stored[env, 0], played["stored"][env, count])


@pytest.mark.slow
def test_a_world_that_fails_when_it_is_replayed_is_left_out(start, capfd):
    workers = start(EnvSpec(STOOL, {"fault": "reward", "faulty_start": 0.2}), 3, n_workers=1)
    still = np.zeros((5, 2), np.float32)
    left = workers.begin_episodes({0: (4, still[:2]), 1: (5, still), 2: (6, still[:1])}, may_fail=True)
    assert left == {1}


@pytest.mark.slow
def test_limits_apply_in_every_world(start):
    spec, seeds, episodes = EnvSpec(STOOL), list(range(4)), []
    limits = {"joints": ["front_hip", "back_hip"], "limits": {"all": {"action": [-0.1, 0.1]}}}
    for workers in (start(spec, 1), start(spec, 4, n_workers=2)):
        workers.set_policy(linear(workers.info, WEIGHT))
        workers.limit_actions(limits)
        episodes.append(play_episodes(workers, seeds, record=True))
    for alone, among in zip(*episodes, strict=True):
        assert np.abs(among.trajectory.actions).max() <= 0.1 + 1e-6
        assert among.result.report["interventions"]
        assert among.result.report == alone.result.report
