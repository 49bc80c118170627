"""The first episodes of a batch have random lengths, which no split into workers and no resume changes."""

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError
from rlctl.play.workers import Workers
from rlctl.policy.actor import Exploration
from rlctl.training.checkpoint_file import environment_tensors, restore_environments
from rlctl.training.rollouts import WorkerVecEnv
from tests.play.policies import linear

pytest.importorskip("mujoco")

STOOL = EnvSpec("tests.task.batches:Stool")
COUNT = 6


@pytest.fixture
def make():
    """Make environments of mixed ages, whose policy does nothing."""
    made = []

    def start(n_workers: int = 1) -> WorkerVecEnv:
        workers = Workers(STOOL, COUNT, n_workers=n_workers)
        made.append(workers)
        env = WorkerVecEnv(workers, run_seed=7)
        env.mixes_ages = True
        workers.set_policy(linear(workers.info, np.zeros((2, 14))))
        return env

    yield start
    for workers in made:
        workers.close()


def play(env, steps):
    env.start(steps, Exploration())
    return env.finish()


@pytest.mark.slow
def test_first_episodes_are_short_and_no_results(make):
    env = make()
    env.reset()
    limits, longest = env.limits, env.workers.info.max_steps
    assert len(set(limits.tolist())) > 2
    assert (limits >= 1).all()
    assert (limits <= longest).all()
    segment = play(env, 2 * longest)
    for world in range(COUNT):
        first = int(segment.done[world].argmax()) + 1
        assert first == limits[world] or segment.terminated[world, first - 1]
    assert (env.limits == 0).all()
    counted = {(episode.env, episode.row) for episode in env.ended}
    every = {(world, row) for world, row in np.argwhere(segment.done).tolist()}
    assert counted == every - {(world, int(segment.done[world].argmax())) for world in range(COUNT)}


@pytest.mark.slow
@pytest.mark.parametrize("n_workers", [2, 3])
def test_equal_in_any_number_of_workers_and_after_a_resume(make, n_workers):
    whole, resumed = make(), make(n_workers)
    whole.reset()
    play(whole, 5)
    saved = {name: np.array(values) for name, values in environment_tensors(whole).items()}
    expected = play(whole, 40)
    assert restore_environments(resumed, saved) is None
    segment = play(resumed, 40)
    for name in ("reward", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(expected, name), getattr(segment, name))
    assert [episode.row for episode in whole.ended] == [episode.row for episode in resumed.ended]


def test_others_begin_at_once(make):
    env = make()
    env.mixes_ages = False
    env.reset()
    assert (env.limits == 0).all()


def test_a_plain_environment_keeps_its_time_limit(train):
    with pytest.raises(RecipeError, match=r"mixed_ages: .*CartPole-v1 is a plain Gymnasium environment"):
        train("CartPole-v1", {"mixed_ages": True, "total_timesteps": 100})
