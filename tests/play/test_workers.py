"""Environments in worker processes: the same bits on any number of them, every kind of space, all output forwarded."""

import dataclasses
import os
import sys
import threading
import time

import numpy as np
import psutil
import pytest

from rlctl.environments.dict_spaces import join
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError
from rlctl.play.messages import Play
from rlctl.play.workers import Workers
from rlctl.printed_lines import PrintedLines
from rlctl.training.measurements import evaluation_row, training_row
from tests.play.policies import linear

pytestmark = pytest.mark.usefixtures("no_child_left")


def play(workers: Workers, steps: int = 20, policy: str = "random"):
    """Play a segment, the next episode where one ends; return what was observed, rewarded and ended."""
    envs = range(workers.n_envs)
    workers.set_other_policy(policy)
    workers.start_playing(Play(steps, {env: 100 * env for env in envs}, dict.fromkeys(envs, 1), run_seed=3))
    ended = workers.finish_playing()
    segment = workers.arrays.segment
    return segment.observation[""].copy(), segment.reward.copy(), ended


def still(seed: int, steps: int):
    """Return an episode of some steps in which a robot of two joints does nothing."""
    return seed, np.zeros((steps, 2), np.float32)


@pytest.mark.slow
def test_reach_does_not_depend_on_the_number_of_environments(start):
    """Environment 0 plays the same beside one and beside four others."""
    two, five = (play(start(EnvSpec("reach"), n_envs, n_workers=2), 30) for n_envs in (2, 5))
    np.testing.assert_array_equal(two[0], five[0][:2])
    np.testing.assert_array_equal(two[1], five[1][:2])


def test_terms_of_a_task(spec, start):
    workers = start(spec("Counting"), 1)
    workers.set_policy(linear(workers.info, [[0.0]], bias=0.25))
    workers.start_playing(Play(4, {0: 1}, {0: 1}, record=True))
    (result,) = workers.finish_playing()
    segment = workers.arrays.segment
    begin = float(segment.observation[""][0, 0, 0])
    # In the order of the weights, though the task gives them in another.
    assert list(workers.info.reward_weights) == ["count", "fixed"]
    assert segment.terms[0, 3].tolist() == pytest.approx([begin + 1.0, 2.0], abs=1e-6)
    # count: 4 * begin + 0.25 + 0.5 + 0.75 + 1.0; fixed: 4 * 0.5 * 2.0
    assert result.terms == pytest.approx({"count": 4 * begin + 2.5, "fixed": 4.0}, abs=1e-5)
    assert result.total_reward == pytest.approx(sum(result.terms.values()))
    assert (bool(segment.truncated[0, 3]), bool(segment.terminated[0, 3])) == (True, False)


def test_a_term_of_weight_0_is_a_metric(spec, start):
    workers = start(dataclasses.replace(spec("Counting"), reward_weights={"fixed": 0.0}), 1)
    workers.set_policy(linear(workers.info, [[0.0]], bias=0.25))
    workers.start_playing(Play(4, {0: 1}, {0: 1}))
    (result,) = workers.finish_playing()
    assert result.metrics == {"fixed": 2.0}  # as the task returns it, at every step
    assert result.total_reward == pytest.approx(result.terms["count"])
    row = evaluation_row([result])
    assert (row["metric/fixed"], row["term/fixed"]) == (2.0, 0.0)
    row = training_row([], workers.info.reward_weights, {})
    assert [name for name in row if "/" in name] == ["term/count", "term/fixed", "metric/fixed"]


@pytest.mark.slow_except("dict", "binary")
@pytest.mark.parametrize("kind", ["dict", "image", "discrete", "binary"])
def test_every_kind_of_space(spec, start, kind):
    env = spec("Spaces", kind=kind).make()
    workers = start(spec("Spaces", kind=kind), 3, n_workers=1)
    workers.set_other_policy("random")
    workers.start_playing(Play(3, {0: 0, 1: 1, 2: 2}))
    ended = workers.finish_playing()
    segment = workers.arrays.segment
    expected, _ = env.reset(seed=1)
    for step in range(4):
        seen = join({key: rows[1, step] for key, rows in segment.observation.items()})
        if kind == "dict":
            assert {key: value.tolist() for key, value in seen.items()} == {
                key: np.asarray(value).tolist() for key, value in expected.items()
            }
        else:
            assert seen.dtype == env.observation_space.dtype
            np.testing.assert_array_equal(seen, expected)
        if step < 3:
            action = segment.action[1, step]
            expected, reward, *_ = env.step(int(action) if action.shape == () else action)
            assert segment.reward[1, step] == reward
    assert [result.length for result in ended] == [3, 3, 3]


def test_what_environments_print_is_forwarded_at_once(spec, start, capfd):
    lines = []
    workers = start(spec("Walk", fault="print"), 1, printed=PrintedLines(lines.append))
    workers.begin_episodes({0: still(7, 3)})
    deadline = time.monotonic() + 60
    while len(lines) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert sorted(lines) == ["hello from its child", "hello from the environment"]
    assert capfd.readouterr() == ("", "")


def test_without_a_listener_prints_go_to_stderr(spec, start, capfd):
    workers = start(spec("Walk", fault="print"), 1)
    workers.begin_episodes({0: still(7, 3)})
    workers.close()
    out, err = capfd.readouterr()
    assert out == ""
    assert sorted(err.splitlines()) == ["hello from its child", "hello from the environment"]


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreters")
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
    workers = start(EnvSpec(f"{module}:Spy"), 1, printed=PrintedLines(lines.append))
    workers.reset({0: 0})
    workers.close()
    loaded = set(lines[0].split())
    assert "gymnasium" in loaded
    assert not loaded & {"torch", "stable_baselines3", "sb3_contrib", "rerun", "onnxruntime", "rich", "typer"}


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreters")
def test_nothing_is_left_open(spec):
    Workers(spec("Walk"), 1).close()
    process = psutil.Process()
    files, threads = process.num_fds(), threading.active_count()
    with Workers(spec("Walk"), 2, n_workers=1) as workers:
        workers.begin_episodes({0: still(0, 1), 1: still(1, 1)})
    del workers
    workers = Workers(spec("Walk"), 1)
    workers.close()  # before it was used
    workers.close()
    del workers
    assert process.num_fds() == files
    assert threading.active_count() == threads


def test_a_child_of_an_environment_does_not_hold_up_the_end(spec):
    workers = Workers(spec("Holder"), 1)
    workers.reset({0: 0})
    began = time.monotonic()
    workers.close()
    assert time.monotonic() - began < 60


def test_a_misspelt_parameter_keeps_its_kind_of_error(spec, start):
    workers = start(spec("Walk", sise=3), 2)
    with pytest.raises(RecipeError, match=r"has no parameter 'sise'\. Did you mean 'size'\?"):
        _ = workers.info


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreters")
def test_paths_of_this_process_are_those_of_its_workers(start, tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("from tests.play.envs import Walk as Here\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    workers = start(EnvSpec("only_here:Here"), 1)
    workers.reset({0: 0})
    assert workers.info.action_space["shape"] == [2]


@pytest.mark.slow
def test_rebuilt_workers_are_as_new_ones(spec, start):
    workers = start(spec("Walk"), 3, n_workers=2)
    play(workers, 5)
    processes = {child.pid for child in psutil.Process().children()}
    assert workers.rebuild(spec("Walk", size=4)) == start(spec("Walk", size=4), 3).info
    seen, rewards, ended = play(workers)
    assert processes <= {child.pid for child in psutil.Process().children()}
    expected = play(start(spec("Walk", size=4), 3))
    np.testing.assert_array_equal(seen, expected[0])
    np.testing.assert_array_equal(rewards, expected[1])
    assert ended == expected[2]
    assert len(ended) > 3


def test_what_cannot_be_rebuilt_ends_the_workers(spec, start):
    workers = start(spec("Walk"), 2)
    with pytest.raises(RecipeError, match=r"no parameter 'sise'. Did you mean 'size'\?"):
        workers.rebuild(spec("Walk", sise=4))


def test_episodes_end_in_the_order_of_the_environments(spec, start):
    workers = start(spec("Walk"), 6, n_workers=3)
    workers.set_other_policy("zero")
    workers.start_playing(Play(20, dict.fromkeys(range(6), 1)))
    assert [result.env for result in workers.finish_playing()] == [0, 1, 2, 3, 4, 5]


def test_actions_are_replayed_up_to_where_the_episode_was(spec, start):
    workers, env = start(spec("Walk"), 3, n_workers=2), spec("Walk").make()
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 2)).astype(np.float32)
    assert workers.begin_episodes({0: (3, actions), 2: (5, actions[:0]), 1: still(8, 30)}) == {1}
    env.reset(seed=3)
    for action in actions:
        observation, *_ = env.step(action)
    np.testing.assert_array_equal(workers.observations([0])[0], observation)
    np.testing.assert_array_equal(workers.observations([2])[0], env.reset(seed=5)[0])
