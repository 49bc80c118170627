"""Trainings to be killed: what they are, and a client of the server that runs them."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from rlctl.run.directory import RunDirectory
from tests.train.conftest import ENVS

ROOT = Path(__file__).parents[2]


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
        *("algo_kwargs.train_freq=[4,\"step\"]", "algo_kwargs.gradient_steps=1", "checkpoint.keep=2"),
        algo="sac", steps=40, evaluate=24,
    ),
    # Five updates, and three checkpoints to fall back on.
    "ppo, kept": _line(
        *("algo_kwargs.n_steps=8", "algo_kwargs.batch_size=8", "algo_kwargs.n_epochs=2", "checkpoint.keep=3"),
        algo="ppo", steps=80, evaluate=32,
    ),
    "sac, kept": _line(
        *("algo_kwargs.learning_starts=8", "algo_kwargs.batch_size=8", "algo_kwargs.buffer_size=48"),
        *("algo_kwargs.train_freq=[4,\"step\"]", "algo_kwargs.gradient_steps=1", "checkpoint.keep=3"),
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
    def went_on_at(self) -> int:
        """The step that a resume went on from; 0 if it began anew."""
        found = re.search(r"^going on at step ([\d,]+)", self.stderr, re.MULTILINE)
        return int(found[1].replace(",", "")) if found else 0


class ForkServer:
    """Runs trials one after the other."""

    def __init__(self, core: int) -> None:
        # Nothing of the machine's may differ between trials, and the terminal is none.
        environment = {
            **os.environ,
            "PYTHONPATH": f"{ROOT}:{ROOT / 'plugins'}",
            "CRASH_CORE": str(core),
            "TERM": "dumb",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.crash.fork_server"],
            cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def run(self, arguments, folder: Path, **plan) -> Ended:
        """Run a command line in a folder, with what `inside.run` takes as a plan; return how it ended."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("log", "stdout", "stderr"):
            (folder / name).unlink(missing_ok=True)
        request = {"arguments": arguments, "folder": str(folder), "plan": plan}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        texts = [_text(folder / name) for name in ("stdout", "stderr", "log")]
        log = texts[2].splitlines()
        return Ended(arguments, plan, folder, answer["code"], answer["seconds"], answer["orphans"], *texts[:2], log)

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait(timeout=30)


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
