"""Signals and full disks, on the whole command."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from rlctl.errors import Interrupted
from rlctl.training.checkpoints import Checkpoints
from tests import fork_server
from tests.training.conftest import ENVS, TINY

COMMAND = [sys.executable, "-m", "rlctl", "train"]
SMALL = [
    *("--n-envs", "4", "--set", "algo_kwargs.n_steps=16", "--set", "algo_kwargs.batch_size=32"),
    *("--set", "eval.episodes=4", "--set", "eval.every_steps=1_000_000"),
]


def wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return
        time.sleep(0.05)
    pytest.fail("waited in vain")


def fill(file):
    while True:
        file.write(b"\0" * 4096)


@dataclasses.dataclass
class Training:
    """A command that runs, and the files its output goes to."""

    process: Any
    stdout: Path
    stderr: Path

    def wait(self, timeout: float = 120.0) -> tuple[int, str, str]:
        """Wait for its end; return its exit code and what it wrote."""
        code = self.process.wait(timeout=timeout)
        return code, self.stdout.read_text(), self.stderr.read_text()


@pytest.fixture
def start(tmp_path):
    """Start a long training in a folder."""
    started = []

    def begin(
        folder: Path, *arguments: str, task: str = f"{ENVS}:Line", stdout: int | None = None, stderr: int | None = None
    ) -> Training:
        files = [tmp_path / name for name in ("stdout", "stderr")]
        with files[0].open("wb") as out, files[1].open("wb") as err:
            process = fork_server.for_commands().start(
                [*COMMAND, task, "-n", "1e8", *SMALL, *arguments],
                cwd=folder,
                stdout=out.fileno() if stdout is None else stdout,
                stderr=err.fileno() if stderr is None else stderr,
            )
        started.append(process)
        return Training(process, *files)

    yield begin
    for process in started:
        process.kill()
        process.wait()


# Takes seconds, and runs in every `make test`: signals, their exit codes, no process left.
@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow),
        pytest.param(signal.SIGUSR1, 143, marks=pytest.mark.slow),
    ],
)
def test_a_signal_saves_a_checkpoint_and_leaves_no_child(start, rlctl, tmp_path, number, code):
    training = start(tmp_path)
    wait_for(lambda: list(tmp_path.glob("runs/*/*/metrics.csv")))
    children = psutil.Process(training.process.pid).children(recursive=True)
    assert children
    training.process.send_signal(number)
    training.process.send_signal(number)  # as `timeout` does; the same within a second counts once
    for child in children:  # a cluster sends it to every process
        child.send_signal(number)
    returned, stdout, stderr = training.wait()
    assert returned == code
    assert stdout == ""
    last = stderr.strip().splitlines()[-1]
    assert last.startswith("error: interrupted at step ")
    assert "checkpoint saved. Resume with: rlctl train --resume runs/" in last
    assert "Traceback" not in stderr
    wait_for(lambda: not any(child.is_running() for child in children))
    (run,) = tmp_path.glob("runs/Line/*")
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    steps = max(int(each.name) for each in (run / "checkpoints").iterdir())
    done = rlctl("train", "--resume", run, "-n", steps + 64, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["steps"] == steps + 64


def test_a_signal_names_the_last_policy_that_was_never_evaluated(train, every_boundary, monkeypatch, capsys):
    original = Checkpoints.save

    def save(checkpoints, *arguments):
        saved = original(checkpoints, *arguments)
        if checkpoints.saved_step == 32:
            os.kill(os.getpid(), signal.SIGTERM)
        return saved

    monkeypatch.setattr(Checkpoints, "save", save)
    with pytest.raises(Interrupted, match="interrupted at step 64"):
        train("Line", {**TINY, "eval": {"every_steps": 32, "episodes": 1}})
    line = "last is 32 steps newer than best and was never evaluated: --checkpoint last\n"
    assert line in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_run_leaves_no_worker_and_does_not_block_the_next(start, rlctl, tmp_path):
    training = start(tmp_path, "--set", "eval.every_steps=64")
    wait_for(lambda: list(tmp_path.glob("runs/*/*/checkpoints/0*")))
    children = psutil.Process(training.process.pid).children(recursive=True)
    training.process.kill()
    training.wait()
    wait_for(lambda: not any(child.is_running() for child in children))
    (run,) = tmp_path.glob("runs/Line/*")
    steps = max(int(each.name) for each in (run / "checkpoints").iterdir() if each.name.isdigit())
    done = rlctl("train", "--resume", "latest", "-n", steps + 64)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_two_processes_cannot_write_one_run(start, rlctl, tmp_path):
    training = start(tmp_path, "--set", "eval.every_steps=64")
    wait_for(lambda: list(tmp_path.glob("runs/*/*/checkpoints/0*")))
    second = rlctl("train", "--resume", "latest")
    training.process.terminate()
    training.wait()
    assert second.returncode == 75
    assert f"another process is writing this run (pid {training.process.pid} on " in second.stderr


@pytest.mark.slow
def test_a_process_that_has_lost_its_run_writes_nothing_more(start, rlctl, tmp_path):
    training = start(tmp_path, "--set", "eval.every_steps=64")
    wait_for(lambda: list(tmp_path.glob("runs/*/*/checkpoints/0*")))
    (run,) = tmp_path.glob("runs/Line/*")
    # As the lock of another machine's process, on a file system whose locks hold on one machine only.
    (run / ".lock").unlink()
    steps = max(int(folder.name) for folder in (run / "checkpoints").iterdir() if folder.name.isdigit())
    resumed = rlctl("train", "--resume", run, "-n", steps + 4096, "--json", "-")
    code, _, stderr = training.wait()
    assert code == 75
    assert (
        stderr.strip()
        .splitlines()[-1]
        .endswith("another process has taken over this run; this process no longer writes to it")
    )
    assert resumed.returncode == 0, resumed.stderr
    steps = [int(line.partition(",")[0]) for line in (run / "metrics.csv").read_text().splitlines()[1:]]
    assert steps == list(range(64, steps[-1] + 1, 64))
    assert json.loads((run / "run.json").read_text())["status"] == "finished"


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 8 MB."""
    if os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)], capture_output=True, text=True
    )
    if mount.returncode != 0:
        pytest.skip(f"no small file system here: {mount.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.slow
def test_a_full_disk_costs_warnings_and_an_exit_code(start, rlctl, small_disk):
    filler = small_disk / "filler"
    training = start(small_disk, "--set", "eval.every_steps=1_500", "-n", "3_000")
    wait_for(lambda: list(small_disk.glob("runs/*/*/checkpoints/0*")))
    with filler.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space left"):
        fill(file)
    code, _, stderr = training.wait()
    assert code == 5, stderr
    assert "warning: not saved: " in stderr
    assert "No space left on device" in stderr
    assert "the training is done, but could not be saved" in stderr.strip().splitlines()[-1]
    filler.unlink()
    done = rlctl("train", "--resume", "latest", cwd=small_disk)
    assert done.returncode == 0, done.stderr
    assert ", bit-exact" in done.stderr
    assert "Traceback" not in stderr


@pytest.mark.slow
def test_a_reader_that_leaves_interrupts_the_training(start, tmp_path):
    """As `rlctl train ... 2>&1 | head -1` does."""
    read_end, write_end = os.pipe()
    training = start(tmp_path, "--set", "eval.every_steps=64", stderr=write_end)
    os.close(write_end)
    assert os.read(read_end, 5) == b"train"
    os.close(read_end)
    assert training.wait()[0] == 141
    (run,) = tmp_path.glob("runs/Line/*")
    status = json.loads((run / "run.json").read_text())
    assert (status["status"], status["error"].partition(" at ")[0]) == ("interrupted", "interrupted")
    assert list(run.glob("checkpoints/0*"))


@pytest.mark.slow
def test_stdout_closed_early_is_silent(start, tmp_path):
    read_end, write_end = os.pipe()
    os.close(read_end)
    training = start(tmp_path, "-n", "256", stdout=write_end)
    os.close(write_end)
    code, _, stderr = training.wait()
    assert code == 141
    assert "Traceback" not in stderr
    assert "error" not in stderr


@pytest.mark.slow
def test_what_a_plugin_prints_stays_out_of_the_result(rlctl, tmp_path):
    (tmp_path / "chatty.py").write_text(
        f"import sys; sys.path.append({str(ENVS.parent)!r}); print('hello from the import')\n"
        "from envs import Line\n"
        "class Chatty(Line):\n"
        "    def reset(self, **options):\n"
        "        print('hello from the reset')\n"
        "        return super().reset(**options)\n"
    )
    done = rlctl("train", "chatty.py:Chatty", "-n", "64", *SMALL, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["steps"] == 64
    assert "hello from the import" in done.stderr
    assert "hello from the reset" in done.stderr
