"""Return over minutes of rlctl, RL Baselines3 Zoo and sbx on the same cores: `make compare`. Hours.

One training runs at a time, with all cores: on one of two, rl-zoo3's TQC has 0.8 times the steps/s, sbx's 0.6 times.
Minutes count from the start of the process and include evaluations. What was measured before, and its folder, is kept
in build/compare; the table and the picture are written from all of it. trainers.py says what the peers need.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rlctl.storage import files
from tests.benchmarks.trainers import EPISODES, PACKAGES, PEERS, SCORES, TRAINERS

PUBLISHED = {  # the scores of the recipes: return, steps until it falls, success
    "ant": 3300.0,
    "half-cheetah": 2950.0,
    "hopper": 2600.0,
    "walker2d": 2200.0,
    "humanoid": 900.0,
    "reach": 0.95,
}
_POLL_S = 0.5
_NAMES = {sys.executable: "python"} | {os.environ[name]: f"${name}" for name in PEERS.values() if name in os.environ}
FOLDER, PAGE = Path("build/compare"), Path("docs/compare.md")


@dataclasses.dataclass
class Curve:
    """The evaluations of a training."""

    task: str
    tool: str
    seed: int
    version: str
    command: str
    minutes: list[float]
    scores: list[float]

    def minutes_to(self, score: float) -> float:
        """Return the minutes to the first evaluation with a score; infinity if there is none."""
        return next((m for m, reached in zip(self.minutes, self.scores, strict=True) if reached >= score), math.inf)

    def best_after(self, minutes: float) -> float | None:
        """Return the best score of the evaluations until then; None if there was none."""
        return max((s for m, s in zip(self.minutes, self.scores, strict=True) if m <= minutes), default=None)


def measure(task: str, tool: str, seed: int, limit_minutes: float) -> Curve:
    """Train until the tool ends or the time is over; raises `RuntimeError` if it is missing or fails."""
    version = read_version(tool)
    folder = (FOLDER / f"{task}_{tool}_{seed}").resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command, read = TRAINERS[tool](task, seed, folder)
    evaluations = follow(command, read, folder / "log.txt", limit_minutes)
    minutes, scores = ([row[part] for row in evaluations] for part in (0, 1))
    return Curve(task, tool, seed, version, describe_command(command, folder), minutes, scores)


def describe_command(command: list[str], folder: Path) -> str:
    """Return a command as the page shows it, with the names of its Python and its folder."""
    return f"{_NAMES[command[0]]} {shlex.join(command[1:])}".replace(str(folder), "FOLDER")


def follow(
    command: list[str], read: Callable[[], list[float]], log: Path, limit_minutes: float
) -> list[tuple[float, float]]:
    """Run a training until it ends or the time is over; return when each evaluation was seen [min], and its score.

    Raises `RuntimeError` if it fails.
    """
    evaluations: list[tuple[float, float]] = []
    began = time.monotonic()

    def add_new() -> None:
        minutes = (time.monotonic() - began) / 60
        evaluations.extend((minutes, score) for score in read()[len(evaluations) :])

    with log.open("wb") as output, _start(command, output) as process:
        while process.poll() is None and time.monotonic() - began < 60 * limit_minutes:
            time.sleep(_POLL_S)
            add_new()
        was_stopped = process.poll() is None
    add_new()
    if not was_stopped and process.returncode != 0:
        raise RuntimeError(f"{shlex.join(command)}: exit code {process.returncode}\n{log.read_text()[-2000:]}")
    return evaluations


def read_version(tool: str) -> str:
    """Return the package of a tool and its version; raises `RuntimeError` if it is missing."""
    package, python = PACKAGES[tool], os.environ[PEERS[tool]] if tool in PEERS else sys.executable
    ask = f"import importlib.metadata; print(importlib.metadata.version({package!r}))"
    try:
        found = subprocess.run([python, "-c", ask], check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise RuntimeError(f"{python} is no Python with {package}; trainers.py says what the peers need") from error
    return f"{package} {found.stdout.strip()}"


@contextlib.contextmanager
def _start(command: list[str], output: Any) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)  # its workers too
            process.wait()


def write_page(curves: list[Curve], limit_minutes: float) -> None:
    """Write the table of all curves."""
    lines = [
        "# How long a training takes, next to RL Baselines3 Zoo and sbx\n",
        f"Written by `make compare` on {describe_machine()}, {', '.join(dict.fromkeys(c.version for c in curves))}.",
        "One training at a time; minutes from the start of the process, evaluations included.",
        "rl-zoo3 has its own tuned hyperparameters (TQC), for `reach` those of an earlier recipe of rlctl (PPO).",
        "sbx has TQC [256, 256] with the zoo's learning rate, batch, gamma and tau, for `reach` PPO.",
        f"Peers are evaluated on {EPISODES} episodes, rlctl as its recipes say. If a training ended earlier, its best",
        "score counts. The score is the return, of `reach` the success rate, of `humanoid` the length of an episode,",
        "which ends after 1,000 steps or where the robot falls. `make compare TASKS=ant` adds a task.",
        "Gymnasium's MuJoCo robots after equal numbers of steps: [their scores](mujoco-scores.md).\n",
        "![score over minutes](pictures/compare.png)\n",
        f"| task | score to reach | tool | seed | minutes to it | best score within {limit_minutes:g} minutes |",
        "|---|---|---|---|---|---|",
    ]
    for curve in curves:
        goal, best = PUBLISHED[curve.task], curve.best_after(limit_minutes)
        reached = curve.minutes_to(goal)
        form = ".0%" if SCORES[curve.task] == "success" else ",.0f"
        cells = [
            f"`{curve.task}`",
            f"{goal:{form}}",
            curve.tool,
            str(curve.seed),
            "not reached" if reached == math.inf else f"{reached:.1f}",
            "no evaluation" if best is None else f"{best:{form}}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    ahead = ", ".join(f"{curve.tool} in `{curve.task}`" for curve in _find_peers_ahead(curves))
    lines += ["", f"Earlier at the score than every seed of rlctl: {ahead or 'no peer'}."]
    commands = dict.fromkeys(f"{curve.tool}: `{curve.command}`" for curve in curves)
    files.write_text(PAGE, "\n".join([*lines, "", "The commands:\n", *(f"- {text}" for text in commands), ""]))


def _find_peers_ahead(curves: list[Curve]) -> list[Curve]:
    ours = {
        task: [c.minutes_to(goal) for c in curves if (c.task, c.tool) == (task, "rlctl")]
        for task, goal in PUBLISHED.items()
    }
    return [c for c in curves if c.minutes_to(PUBLISHED[c.task]) < min(ours[c.task], default=0.0)]


def describe_machine() -> str:
    """Return cores, processor and the versions of torch and numpy."""
    with open("/proc/cpuinfo") as info:
        model = next((line.partition(":")[2].strip() for line in info if line.startswith("model name")), "")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("torch", "numpy"))
    return f"{os.cpu_count()} cores of {model or platform.machine()}, {versions}"


def draw(curves: list[Curve], target: Path) -> None:
    """Draw the score over minutes, a panel per task and a line per training."""
    from matplotlib.figure import Figure

    tasks = list(dict.fromkeys(curve.task for curve in curves))
    columns = min(3, len(tasks))
    rows = -(-len(tasks) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.8 * rows), layout="constrained")
    lines = {}
    for number, task in enumerate(tasks, start=1):
        axes = figure.add_subplot(rows, columns, number, title=task, xlabel="minutes")
        axes.axhline(PUBLISHED[task], color="0.7", linestyle=":")
        for curve in curves:
            if curve.task == task:
                color = f"C{list(TRAINERS).index(curve.tool)}"
                (lines[curve.tool],) = axes.plot(curve.minutes, curve.scores, color=color)
        axes.set_ylabel(SCORES[task])
    figure.axes[0].legend(lines.values(), lines, frameon=False)
    figure.savefig(target, dpi=110)


def main() -> int:
    """Measure what is missing, and write the page and the picture."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.compare", description=__doc__)
    parser.add_argument("tasks", nargs="*", default=list(PUBLISHED), help="default: all")
    parser.add_argument("--tools", nargs="*", default=list(TRAINERS), choices=list(TRAINERS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="limit of one training")
    options = parser.parse_args()
    for task in options.tasks:
        if task not in PUBLISHED:
            parser.error(f"no task {task!r} here; give {', '.join(PUBLISHED)}")
    for tool in options.tools:
        if tool in PEERS and PEERS[tool] not in os.environ:
            parser.error(f"set {PEERS[tool]} to a Python with {tool} and rlctl, or give --tools rlctl")
    FOLDER.mkdir(parents=True, exist_ok=True)
    for task in options.tasks:
        for seed in options.seeds:
            for tool in options.tools:
                file = FOLDER / f"{task}_{tool}_{seed}.json"
                if not file.exists():
                    print(f"{task} {tool} seed {seed}", file=sys.stderr, flush=True)
                    files.write_json(file, dataclasses.asdict(measure(task, tool, seed, options.minutes)))
    curves = [Curve(**json.loads(file.read_text())) for file in FOLDER.glob("*.json")]
    curves.sort(key=lambda curve: (list(PUBLISHED).index(curve.task), list(TRAINERS).index(curve.tool), curve.seed))
    write_page(curves, 30.0)
    draw(curves, Path("docs/pictures/compare.png"))
    return 0


if __name__ == "__main__":
    try:
        code = main()
    except KeyboardInterrupt:
        print(f"interrupted: what was measured to the end is kept in {FOLDER}", file=sys.stderr)
        code = 130
    except RuntimeError as error:  # of a training
        print(f"error: {error}", file=sys.stderr)
        code = 1
    sys.exit(code)
