"""Trains reach as a user does: the real command, in a process of its own."""

from __future__ import annotations

import atexit
import csv
import dataclasses
import functools
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rlctl.runs.directory import RunDirectory

GOOD = 0.95  # success rate over the recipe's evaluation episodes
_POLL_S = 0.02


@dataclasses.dataclass(frozen=True)
class Training:
    """A finished `rlctl train reach`."""

    folder: Path
    seconds_to_good: float | None
    """From process start to the end of the first evaluation at `GOOD` or more."""

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of collecting and learning, without the time of evaluations."""
        rows = read_csv(RunDirectory(self.folder).metrics_file)
        done, seconds = 0.0, 0.0
        for row in rows:
            steps = float(row["steps"])
            seconds += (steps - done) / float(row["fps"])
            done = steps
        return done / seconds


def rlctl_command(*arguments: str) -> str:
    """Run `rlctl`; return what it printed to stdout."""
    done = subprocess.run(
        [sys.executable, "-m", "rlctl", *arguments], check=True, text=True, stdout=subprocess.PIPE, cwd=_scratch()
    )
    return done.stdout


@functools.cache
def train(seed: int) -> Training:
    """Train with the recipe as shipped, to its end; each seed once, for all rows that need it."""
    root = _scratch() / f"seed{seed}"
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "rlctl", "train", "reach", "--seed", str(seed), "-o", str(root)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    good: float | None = None
    while process.poll() is None:
        time.sleep(_POLL_S)
        if good is None and _reached(root):
            good = time.perf_counter() - began
    if process.returncode != 0:
        raise RuntimeError(f"rlctl train reach --seed {seed} ended with exit code {process.returncode}")
    return Training((root / "latest").resolve(), good)


@functools.cache
def short_run() -> Path:
    """Return the folder of the shortest training there is, for rows that do not care how good the policy is."""
    root = _scratch() / "short"
    rlctl_command("train", "reach", "-n", "1", "--set", "eval.episodes=1", "-o", str(root))
    return (root / "latest").resolve()


@functools.cache
def evaluate(seed: int, tolerance: float) -> float:
    """Return the success rate of the best policy of a training, over 100 episodes it has not seen."""
    run = str(train(seed).folder)
    text = rlctl_command("eval", run, "--set", f"task.tolerance={tolerance}", "--seed", str(1000 + seed), "--json", "-")
    result: dict[str, Any] = json.loads(text)
    return float(result["success_rate"])


def read_csv(file: Path) -> list[dict[str, str]]:
    """Return the rows of a table by their headers."""
    with file.open(newline="") as lines:
        return list(csv.DictReader(lines))


def _reached(root: Path) -> bool:
    evals = RunDirectory(root / "latest").evals_file
    return evals.exists() and any(float(row["success"]) >= GOOD for row in read_csv(evals))


@functools.cache
def _scratch() -> Path:
    folder = tempfile.TemporaryDirectory(prefix="rlctl-bench-")
    atexit.register(folder.cleanup)
    return Path(folder.name)
