"""Trainings beside each other, and away from the main thread."""

import json
import signal
import subprocess
import sys
import threading

import pytest

from rlctl.errors import UsageError
from tests.training.comparing import assert_same_run
from tests.training.conftest import ENVS, TINY


@pytest.mark.slow
def test_in_a_thread_a_training_is_the_same(train):
    """There are no signal handlers there, and the caller's own are left alone."""
    whole = train("Line", TINY).run
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    found = []

    def run():
        found.append(train("Line", TINY).run)
        found.append([signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)])

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(timeout=250)
    run, during = found
    assert during == before
    assert_same_run(whole, run)


@pytest.mark.slow
def test_two_processes_that_begin_the_same_run_at_once(tmp_path):
    settings = [part for each in ("n_steps=16", "batch_size=32") for part in ("--set", f"algo_kwargs.{each}")]
    command = [sys.executable, "-m", "rlctl", "train", f"{ENVS}:Line", "--no-check", "-n", "64", "--n-envs", "2"]
    both = [
        subprocess.Popen(
            [*command, *settings, "--set", "eval.episodes=1", "--json", "-"],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    results = [process.communicate(timeout=250) for process in both]
    assert [process.returncode for process in both] == [0, 0], results
    one, other = (json.loads(stdout) for stdout, _ in results)
    assert one["run"] != other["run"]
    assert one["steps"] == other["steps"] == 64
    assert one["best"]["mean_return"] == other["best"]["mean_return"]
    latest = (tmp_path / "runs" / "latest").resolve()
    assert latest in [(tmp_path / each["run"]).resolve() for each in (one, other)]


@pytest.mark.slow
def test_a_run_that_another_process_writes(train, resume):
    run = train("Line", TINY).run
    with (
        run.lock(),
        pytest.raises(UsageError, match=r"another process is writing this run \(pid \d+ on \S+\)$") as caught,
    ):
        resume(run, total_timesteps=160)
    assert caught.value.exit_code == 75
    resume(run, total_timesteps=160)
