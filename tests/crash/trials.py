"""Trainings to be killed: what they are, and how they are run."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import psutil

from rlctl.runs.directory import RunDirectory
from tests import fork_server
from tests.training.conftest import ENVS


def _line(*settings, algo, steps, evaluate):
    return [
        *("train", f"{ENVS}:Line", "--algo", algo, "-n", str(steps), "--n-envs", "2", "--no-check"),
        *(part for each in settings for part in ("--set", each)),
        *("--set", "eval.episodes=2", "--set", f"eval.every_steps={evaluate}", "--set", "policy_kwargs.net_arch=[4]"),
    ]


ARGUMENTS = {
    # Three updates, two evaluations, and from the second checkpoint on an old one is removed.
    "ppo": _line(
        *("algo_kwargs.n_steps=8", "algo_kwargs.batch_size=8", "algo_kwargs.n_epochs=2", "checkpoint.keep=1"),
        algo="ppo", steps=48, evaluate=32,
    ),
    # The ring of the replay buffer closes, and its segments are merged and removed.
    "sac": _line(
        *("algo_kwargs.learning_starts=8", "algo_kwargs.batch_size=8", "algo_kwargs.buffer_size=24"),
        *("algo_kwargs.train_freq=4", "algo_kwargs.gradient_steps=1", "checkpoint.keep=2"),
        algo="sac", steps=40, evaluate=24,
    ),
    # Five updates, and three checkpoints to fall back on.
    "ppo, kept": _line(
        *("algo_kwargs.n_steps=8", "algo_kwargs.batch_size=8", "algo_kwargs.n_epochs=2", "checkpoint.keep=3"),
        algo="ppo", steps=80, evaluate=32,
    ),
    "sac, kept": _line(
        *("algo_kwargs.learning_starts=8", "algo_kwargs.batch_size=8", "algo_kwargs.buffer_size=48"),
        *("algo_kwargs.train_freq=4", "algo_kwargs.gradient_steps=1", "checkpoint.keep=3"),
        algo="sac", steps=48, evaluate=16,
    ),
}  # fmt: skip
"""Command lines of `rlctl` by name."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """How a trial ended, and what it left."""

    arguments: list[str]
    plan: dict
    folder: Path
    code: int
    """Exit code; the negative number of a signal that killed it."""
    seconds: float
    orphans: list[str]
    stdout: str
    stderr: str
    log: list[str]

    @property
    def announced(self) -> int:
        """Step of the last checkpoint that was announced as saved; 0 if none was."""
        return max((int(line.split()[1]) for line in self.log if line.startswith("saved ")), default=0)

    @property
    def operations(self) -> int:
        """How many operations on the disk there were."""
        return max((int(line.split()[1]) for line in self.log if line.startswith("operation ")), default=0)

    @property
    def resumed_at(self) -> int:
        """The step at which a resume continued; 0 if it started from the first step."""
        match = re.search(r"^resuming at step ([\d,]+)", self.stderr, re.MULTILINE)
        return int(match[1].replace(",", "")) if match else 0


class Trials:
    """Runs trials one after the other, on one core."""

    def __init__(self, core: int) -> None:
        self._core = core

    def run(self, arguments, folder: Path, *, send=(), **plan) -> Ended:
        """Run a command line in a folder, with what `inside.run` takes as a plan; return how it ended.

        `send` are signals, [when, number] each; `when` is in seconds, or the name of a file that is waited for.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("log", "stdout", "stderr"):
            (folder / name).unlink(missing_ok=True)
        job = json.dumps([arguments, {"core": self._core, **plan}])
        began = time.monotonic()
        with (folder / "stdout").open("wb") as stdout, (folder / "stderr").open("wb") as stderr:
            process = fork_server.for_commands().start(
                [sys.executable, "-m", "tests.crash.inside", job],
                cwd=folder, stdin=subprocess.DEVNULL, stdout=stdout.fileno(), stderr=stderr.fileno(),
                env={**os.environ, "TERM": "dumb"}, start_new_session=True,
            )  # fmt: skip
        _send_signals(process, folder, send)
        code = process.wait()
        seconds = time.monotonic() - began
        texts = [_text(folder / name) for name in ("stdout", "stderr", "log")]
        return Ended(
            arguments, plan, folder, code, seconds, end_orphans(process.pid), *texts[:2], texts[2].splitlines()
        )


def _send_signals(process, folder, send):
    began = time.monotonic()
    for when, number in send:
        while not (folder / when).exists() if isinstance(when, str) else time.monotonic() < began + when:
            if process.poll() is not None:
                return
            time.sleep(0.001)
        process.send_signal(number)


def members(session: int) -> list[psutil.Process]:
    """Return the processes of a session that have not ended."""
    found = []
    for pid in psutil.pids():
        try:
            if os.getsid(pid) == session and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
                found.append(psutil.Process(pid))
        except (ProcessLookupError, psutil.NoSuchProcess):
            continue
    return found


def end_orphans(session: int, patience_s: float = 60.0) -> list[str]:
    """Wait for the end of a session's processes; kill those that do not end, and return their commands."""
    deadline = time.monotonic() + patience_s
    while (left := members(session)) and time.monotonic() < deadline:
        time.sleep(0.01)
    commands = [f"{each.pid} {' '.join(each.cmdline())[:80]}" for each in left]
    for each in left:
        each.kill()
    return commands


def operation_after(whole: Ended, step: int) -> int:
    """Return the number of the first operation after a run without faults announced the checkpoint of a step."""
    place = whole.log.index(f"saved {step}")
    return next(int(line.split()[1]) for line in whole.log[place:] if line.startswith("operation "))


def resume(run: RunDirectory) -> list[str]:
    """Return the command line that goes on with a run."""
    return ["train", "--resume", str(run.path)]


def _text(file):
    return file.read_text() if file.exists() else ""  # there is none yet if it was killed at once


def only_run(folder: Path) -> RunDirectory | None:
    """Return the newest run in a trial's folder; None if there is none that can be resumed."""
    runs = sorted(folder.glob("runs/Line/*/run.json"))
    return RunDirectory(runs[-1].parent) if runs else None


def copied(run: RunDirectory, folder: Path) -> RunDirectory:
    """Copy a run into the folder of another trial."""
    target = folder / "runs" / "Line" / run.path.name
    shutil.copytree(run.path, target)
    return RunDirectory(target)
