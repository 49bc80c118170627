"""Rewards for other goals, asked of the workers: the same bits, and a word for every fault."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.play.messages import Play
from tests.play.conftest import ENVS

pytestmark = pytest.mark.usefixtures("no_child_left")


@pytest.fixture
def goals():
    """Return goals reached and goals wanted, shape (7, 3)."""
    rng = np.random.default_rng(3)
    return rng.normal(size=(7, 3)), rng.normal(size=(7, 3))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rewards_are_those_of_this_process_bit_for_bit(spec, start, goals, dtype):
    achieved, desired = (each.astype(dtype) for each in goals)
    rewards = start(spec("Goals"), 4, n_workers=2).compute_rewards(achieved, desired)
    expected = spec("Goals").make().unwrapped.compute_reward(achieved, desired, [{}] * 7)
    assert rewards.dtype == np.float64
    assert rewards.tolist() == expected.astype(np.float64).tolist()


def test_rewards_by_hand(spec, start):
    achieved, desired = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 2.0]]), np.array([[3.0, 4.0, 0.0], [1.0, 2.0, 2.0]])
    # sqrt(9 + 16) = 5, and nothing; a list will do.
    assert start(spec("Goals", fault="list"), 1).compute_rewards(achieved, desired).tolist() == [-5.0, 0.0]


def test_an_array_that_is_no_block_of_memory(spec, start, goals):
    achieved, desired = goals
    workers = start(spec("Goals"), 1)
    as_columns = [np.asfortranarray(each)[::2] for each in goals]
    assert (
        workers.compute_rewards(*as_columns).tolist() == workers.compute_rewards(achieved[::2], desired[::2]).tolist()
    )


@pytest.mark.slow
def test_asking_changes_nothing_of_the_episodes(spec, start, goals):
    seen = []
    for asks in (False, True):
        workers = start(spec("Goals"), 3, n_workers=2)
        workers.set_other_policy("zero")
        workers.reset({0: 1, 1: 2, 2: 3})
        for _ in range(4):
            if asks:
                workers.compute_rewards(*goals)
            workers.start_playing(Play(1, dict.fromkeys(range(3), -1)))
            workers.finish_playing()
        seen.append(np.column_stack([workers.observations(), workers.arrays.segment.reward]))
    np.testing.assert_array_equal(*seen)


def test_rebuilt_environments_answer(spec, start, goals):
    workers = start(spec("Goals", scale=1.0), 2)
    before = workers.compute_rewards(*goals)
    workers.rebuild(spec("Goals", scale=2.0))
    assert workers.compute_rewards(*goals).tolist() == (2.0 * before).tolist()


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "compute_reward raised RuntimeError: the goal has gone"),
        ("exit", "compute_reward raised SystemExit: done here"),
        ("column", "compute_reward returned shape (7, 1) for 7 goals at once, not (7,)"),
        ("number", "compute_reward returned shape () for 7 goals at once, not (7,)"),
        ("nan", "compute_reward is nan for achieved [2. 2. 2.], desired [0. 0. 0.]"),
        ("text", "compute_reward returned an array of <U32, not of numbers"),
        ("_exit", "worker 0 ended with exit code 4 while in compute_reward\nit ran the environments 0 to 1"),
    ],
)
def test_a_fault_names_compute_reward(spec, start, fault, message):
    workers = start(spec("Goals", fault=fault), 4, n_workers=2)
    with pytest.raises(TaskError) as caught:
        workers.compute_rewards(np.arange(7.0)[:, None] * np.ones(3), np.zeros((7, 3)))
    assert str(caught.value) == f"task '{ENVS}:Goals': {message}"
    assert caught.value.exit_code == 3


def test_the_environments_own_traceback_comes_along(spec, start, goals):
    with pytest.raises(TaskError) as caught:
        start(spec("Goals", fault="raise"), 1).compute_rewards(*goals)
    assert 'raise RuntimeError("the goal has gone")' in caught.value.details


def test_a_hang_is_ended(spec, start, goals):
    workers = start(spec("Goals", fault="hang"), 2)
    assert workers.info.has_compute_reward  # they are built
    workers.timeout_s = 1.0
    with pytest.raises(TaskError, match=r"no answer for 1 s while in compute_reward; .* raise --env-timeout"):
        workers.compute_rewards(*goals)


def test_an_environment_without_it(spec, start, goals):
    with pytest.raises(TaskError, match=r"compute_reward raised AttributeError: 'Walk' object has no attribute"):
        start(spec("Walk"), 1).compute_rewards(*goals)
