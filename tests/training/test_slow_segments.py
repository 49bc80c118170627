"""Segments that take long: progress is shown inside them, and a signal does not wait for their end."""

import json
import signal
import time

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.play.workers import Workers
from rlctl.policy.actor import Exploration
from rlctl.runs.directory import RunDirectory
from rlctl.training import display
from rlctl.training.checkpoint_file import environment_tensors
from rlctl.training.display import Display
from rlctl.training.loop import _SEGMENT_MAY_TAKE_S
from rlctl.training.rollouts import WorkerVecEnv
from tests.training.conftest import ENVS
from tests.training.test_interruption import start, wait_for  # noqa: F401 (a fixture)

SLOW = f"{ENVS.with_name('slow_envs.py')}:Slow"


def test_inside_a_segment_the_state_is_that_of_its_beginning():
    with Workers(EnvSpec(SLOW, {"step_s": 0.02}), 3, n_workers=1) as workers:
        env = WorkerVecEnv(workers, run_seed=4)
        first = env.reset()
        workers.set_other_policy("random")
        assert env.steps_in_segment == 0
        env.start(10, Exploration())
        inside = workers.arrays.inside
        wait_for(lambda: inside[1, 2] >= 2)  # environment 0 is done, 1 is being played, 2 has not begun
        assert inside[2, 2] == -1
        tensors = environment_tensors(env)
        assert 10 < env.steps_in_segment < 20
        assert not np.array_equal(workers.arrays.observation[""][0], first[0])
        np.testing.assert_array_equal(tensors["environments/observation/"], first)
        assert tensors["environments/steps"].tolist() == [0, 0, 0]
        env.finish()
        np.testing.assert_array_equal(env.last_observations()[""], workers.observations())
        assert env.steps_in_segment == 0


def test_a_log_has_lines_inside_a_slow_segment(monkeypatch, capsys):
    monkeypatch.setattr(display, "_LINE_OF_SEGMENT_EVERY_S", 0.05)
    log = Display("train slow (ppo)", 1000)
    log.playing(0)
    time.sleep(0.1)
    log.playing(0)  # nothing has begun
    log.playing(3)
    log.playing(4)  # too soon after the last line
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("3/1,000 steps  ")
    assert line.endswith(" steps/s")


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_signal_stops_a_slow_segment(start, rlctl, tmp_path, algo):  # noqa: F811
    settings = {
        "ppo": ("algo_kwargs.n_steps=64", "algo_kwargs.batch_size=64"),
        "sac": ("algo_kwargs.train_freq=64", "overlap=true"),
    }[algo]
    options = [option for setting in settings for option in ("--set", setting)]
    small = ["--n-envs", "2", "--set", "eval.episodes=1", "--set", "eval.every_steps=1e6", *options]
    training = start(tmp_path, *small, "--algo", algo, "--set", "task.step_s=0.1", task=SLOW)
    wait_for(lambda: list(tmp_path.glob("runs/*/*/metrics.csv")))
    (run,) = tmp_path.glob("runs/Slow/*")
    time.sleep(1.0)  # the second segment, of over ten seconds, has begun
    training.process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    code, _, stderr = training.wait()
    assert (code, time.monotonic() - began < _SEGMENT_MAY_TAKE_S + 4.0) == (143, True)
    assert "Resume with" in stderr
    newest = RunDirectory(run).checkpoints()[-1]
    done = rlctl("train", "--resume", run, "-n", int(newest.name) + 2, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert ", bit-exact" in done.stderr
    assert json.loads(done.stdout)["steps"] > int(newest.name)


@pytest.mark.slow
def test_a_signal_stops_slow_first_resets(start, tmp_path):  # noqa: F811
    training = start(tmp_path, "--no-check", "--set", "task.reset_s=30.0", task=SLOW)
    wait_for(lambda: list(tmp_path.glob("runs/*/*/run.json")))
    time.sleep(1.0)
    training.process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    code, _, stderr = training.wait()
    assert (code, time.monotonic() - began < 8.0) == (143, True)
    assert stderr.strip().endswith("error: interrupted before the training began")
