"""Environments in worker processes: the same bits on any number of them, every kind of space, all output forwarded."""

import os
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from rlctl.env_spec import EnvSpec
from rlctl.errors import RecipeError
from rlctl.rollout.workers import Workers

pytestmark = pytest.mark.usefixtures("no_child_left")


def roll(workers: Workers, steps: int, seed: int = 5):
    """Step with random actions, episodes following one another; return everything that was seen."""
    n_envs = workers.n_envs
    workers.reset({env: 100 * env for env in range(n_envs)})
    arrays, rng = workers.arrays, np.random.default_rng(seed)
    episodes = np.zeros(n_envs, int)
    arrays.next_seed[:] = 100 * np.arange(n_envs) + 1
    seen, ended = [workers.observations()], []
    for _ in range(steps):
        arrays.action[:] = rng.uniform(-1, 1, arrays.action.shape)
        for result in workers.step():
            ended.append((result, workers.final_observations([result.env])))
            episodes[result.env] += 1
            arrays.next_seed[result.env] += 1
        seen.append(np.column_stack([workers.observations(), arrays.reward, arrays.terminated, arrays.truncated]))
    ended.sort(key=lambda pair: (pair[0].seed, pair[0].env))
    return seen, ended


def test_results_do_not_depend_on_the_number_of_workers(spec, start):
    one, three = (roll(start(spec("Walk"), 6, n_workers=n), 40) for n in (1, 3))
    for a, b in zip(one[0], three[0], strict=True):
        np.testing.assert_array_equal(a, b)
    assert [result for result, _ in one[1]] == [result for result, _ in three[1]]
    for (_, a), (_, b) in zip(one[1], three[1], strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(one[1]) > 12


def test_reach_does_not_depend_on_the_number_of_environments(start):
    """Environment 0 plays the same beside one and beside four others."""
    rows = []
    for n_envs in (2, 5):
        workers = start(EnvSpec("reach"), n_envs, n_workers=2)
        workers.reset({env: env for env in range(n_envs)})
        rng = np.random.default_rng(0)
        seen = [workers.observations([0, 1])]
        for _ in range(30):
            workers.arrays.action[:2] = rng.uniform(-1, 1, (2, 7))
            workers.step()
            seen.append(np.column_stack([workers.observations([0, 1]), workers.arrays.reward[:2]]))
        rows.append(seen)
    for a, b in zip(*rows, strict=True):
        np.testing.assert_array_equal(a, b)


def test_workers_step_as_this_process_does(spec, start):
    workers = start(spec("Walk"), 2)
    env = spec("Walk").make()
    workers.reset({0: 3, 1: 4})
    workers.arrays.next_seed[:] = -1
    observation, _ = env.reset(seed=4)
    np.testing.assert_array_equal(workers.observations([1])[0], observation)
    total, length, done = 0.0, 0, False
    while not done:
        workers.arrays.action[:] = 0.5
        ended = workers.step()
        observation, reward, done, _, info = env.step(np.full(2, 0.5, np.float32))
        total, length = total + reward, length + 1
        assert workers.arrays.reward[1] == reward
    (result,) = [result for result in ended if result.env == 1]
    assert (result.seed, result.total_reward, result.length) == (4, total, length)
    assert result.success is info["is_success"]
    assert result.final_distance == info["distance"]
    np.testing.assert_array_equal(workers.final_observations([1])[0], observation)


def test_an_environment_rests_without_a_next_seed(spec, start):
    workers = start(spec("Walk"), 2, n_workers=1)
    workers.reset({0: 1, 1: 2})
    workers.arrays.next_seed[:] = [-1, 9]
    ended = []
    for _ in range(60):
        workers.arrays.action[:] = 0.0
        ended += workers.step()
    assert [result.seed for result in ended if result.env == 0] == [1]
    assert [result.seed for result in ended if result.env == 1][:2] == [2, 9]
    before = workers.observations([0])
    workers.step()
    np.testing.assert_array_equal(workers.observations([0]), before)


def test_terms_of_a_task(spec, start):
    workers = start(spec("Counting"), 1)
    workers.reset({0: 1})
    begin = float(workers.observations()[0, 0])
    workers.arrays.action[:] = 0.25
    workers.arrays.record[:] = True
    results = [result for _ in range(4) for result in workers.step()]
    # In the order of the weights, though the task gives them in another.
    assert list(workers.info.reward_weights) == ["count", "fixed"]
    assert workers.arrays.terms[0].tolist() == pytest.approx([begin + 1.0, 2.0], abs=1e-6)
    (result,) = results
    # count: 4 * begin + 0.25 + 0.5 + 0.75 + 1.0; fixed: 4 * 0.5 * 2.0
    assert result.terms == pytest.approx({"count": 4 * begin + 2.5, "fixed": 4.0}, abs=1e-5)
    assert result.total_reward == pytest.approx(sum(result.terms.values()))
    assert (bool(workers.arrays.truncated[0]), bool(workers.arrays.terminated[0])) == (True, False)


@pytest.mark.parametrize("kind", ["dict", "image", "discrete", "binary"])
def test_every_kind_of_space(spec, start, kind):
    env = spec("Spaces", kind=kind).make()
    workers = start(spec("Spaces", kind=kind), 3, n_workers=1)
    workers.reset({0: 0, 1: 1, 2: 2})
    workers.arrays.next_seed[:] = -1
    env.action_space.seed(0)
    expected, _ = env.reset(seed=1)
    for _ in range(3):
        seen = workers.observations([1])
        if kind == "dict":
            assert {key: value[0].tolist() for key, value in seen.items()} == {
                key: np.asarray(value).tolist() for key, value in expected.items()
            }
        else:
            assert seen.dtype == env.observation_space.dtype
            np.testing.assert_array_equal(seen[0], expected)
        action = env.action_space.sample()
        workers.arrays.action[:] = action
        ended = workers.step()
        expected, reward, *_ = env.step(action)
        assert workers.arrays.reward.tolist() == [reward] * 3
    assert [result.length for result in ended] == [3, 3, 3]


def test_what_environments_print_is_forwarded_at_once(spec, start, capfd):
    lines = []
    workers = start(spec("Walk", fault="print"), 1, on_output=lines.append)
    workers.reset({0: 7})
    for _ in range(3):
        workers.step()
    deadline = time.monotonic() + 5
    while len(lines) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert sorted(lines) == ["hello from its child", "hello from the environment"]
    assert capfd.readouterr() == ("", "")


def test_without_a_listener_prints_go_to_stderr(spec, start, capfd):
    workers = start(spec("Walk", fault="print"), 1)
    workers.reset({0: 7})
    for _ in range(3):
        workers.step()
    workers.close()
    out, err = capfd.readouterr()
    assert out == ""
    assert sorted(err.splitlines()) == ["hello from its child", "hello from the environment"]


def test_workers_import_no_learning_library(spec, start, tmp_path):
    module = tmp_path / "spy_env.py"
    module.write_text(
        f"import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})\n"
        "from envs import Walk\n"
        "class Spy(Walk):\n"
        "    def reset(self, **options):\n"
        "        print(*sorted({name.partition('.')[0] for name in sys.modules}))\n"
        "        return super().reset(**options)\n"
    )
    lines = []
    workers = start(EnvSpec(f"{module}:Spy"), 1, on_output=lines.append, start=subprocess.Popen)
    workers.reset({0: 0})
    workers.close()
    loaded = set(lines[0].split())
    assert "gymnasium" in loaded
    assert not loaded & {"torch", "stable_baselines3", "sb3_contrib", "rerun", "onnxruntime", "rich", "typer"}


def test_nothing_is_left_open(spec):
    Workers(spec("Walk"), 1, start=subprocess.Popen).close()
    process = psutil.Process()
    files, threads = process.num_fds(), process.num_threads()
    with Workers(spec("Walk"), 2, start=subprocess.Popen) as workers:
        workers.reset({0: 0, 1: 1})
        workers.step()
    del workers
    workers = Workers(spec("Walk"), 2, start=subprocess.Popen)
    workers.close()  # before it was used
    workers.close()
    del workers
    assert process.num_fds() == files
    assert process.num_threads() == threads


def test_a_child_of_an_environment_does_not_hold_up_the_end(spec):
    workers = Workers(spec("Holder"), 1)
    workers.reset({0: 0})
    began = time.monotonic()
    workers.close()
    assert time.monotonic() - began < 5


def test_a_misspelt_parameter_keeps_its_kind_of_error(spec, start):
    workers = start(spec("Walk", sise=3), 2)
    with pytest.raises(RecipeError, match=r"has no parameter 'sise'\. Did you mean 'size'\?"):
        _ = workers.info


def test_paths_of_this_process_are_those_of_its_workers(start, tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("from tests.rollout.envs import Walk as Here\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    workers = start(EnvSpec("only_here:Here"), 1, start=subprocess.Popen)
    workers.reset({0: 0})
    assert workers.info.action_space["shape"] == [2]


def test_rebuilt_workers_are_as_new_ones(spec, start):
    workers = start(spec("Walk"), 3, n_workers=2)
    roll(workers, 5)
    processes = {child.pid for child in psutil.Process().children()}
    assert workers.rebuild(spec("Walk", size=4)) == start(spec("Walk", size=4), 3).info
    seen, ended = roll(workers, 20)
    assert processes <= {child.pid for child in psutil.Process().children()}
    expected, also = roll(start(spec("Walk", size=4), 3), 20)
    for a, b in zip(seen, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    assert [result for result, _ in ended] == [result for result, _ in also]


def test_what_cannot_be_rebuilt_ends_the_workers(spec, start):
    workers = start(spec("Walk"), 2)
    with pytest.raises(RecipeError, match=r"no parameter 'sise'. Did you mean 'size'\?"):
        workers.rebuild(spec("Walk", sise=4))


def test_episodes_end_in_the_order_of_the_environments(spec, start):
    workers = start(spec("Walk"), 6, n_workers=3)
    workers.reset(dict.fromkeys(range(6), 1))  # one seed, one length: all end in one step
    workers.arrays.next_seed[:] = -1
    workers.arrays.action[:] = 0.0
    ended = []
    while not ended:
        ended = workers.step()
    assert [result.env for result in ended] == [0, 1, 2, 3, 4, 5]
