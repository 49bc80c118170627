"""Returns of Gymnasium's MuJoCo robots after few steps, next to sbx and to published means. Hours.

`python -m tests.benchmarks.mujoco_scores Ant-v5 --tools rlctl "sbx CrossQ" --seeds 0 1 --steps 200000`

One training runs at a time, with all cores. Every evaluation is a row of docs/mujoco-scores.csv, which is kept: the
page and its picture are written from all of it. `--add RUN ...` takes finished runs of rlctl instead of training, for
example two that ran side by side with a core each (`--cores 1`).
trainers.py says what sbx needs.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import io
import itertools
import json
import os
import shlex
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.errors import RlctlError
from rlctl.evaluation.episode_statistics import Spread
from rlctl.play.workers import available_cores
from rlctl.recipe import sources
from rlctl.recipe.recipe import Recipe, fill_parameters
from rlctl.runs.compare.significance import interquartile_mean_interval
from rlctl.runs.directory import RunDirectory
from rlctl.storage import files
from tests.benchmarks.compare import describe_command, describe_machine, follow, read_version
from tests.benchmarks.shipped import read_csv, rlctl_command
from tests.benchmarks.trainers import EPISODES, PEERS, read_evaluations, write_sbx

ROWS, PAGE = Path("docs/mujoco-scores.csv"), Path("docs/mujoco-scores.md")
PICTURE = Path("docs/pictures/mujoco-scores.png")
FOLDER = Path("build/mujoco-scores")
BUDGETS = (200_000, 1_000_000)
EVERY = 20_000  # steps between evaluations
LAST_EPISODES = 100  # of the policy at the end
KEPT = ", best policy"  # of the evaluations during the training: the one that rlctl plays and exports
NOT_AVERAGED = ", last weights"  # evaluated instead of their average
_LEAST_FOR_INTERVAL = 5  # seeds

PUBLISHED = {  # return on v4 after `BUDGETS`: means of ten seeds, from the curves that the authors publish
    "SAC": {
        "Ant": (2296, 5734),
        "HalfCheetah": (7679, 11321),
        "Hopper": (2342, 2787),
        "Humanoid": (994, 4826),
        "Walker2d": (1946, 4536),
    },
    "CrossQ": {
        "Ant": (4918, 6911),
        "HalfCheetah": (9507, 12848),
        "Hopper": (2577, 2471),
        "Humanoid": (5636, 10284),
        "Walker2d": (4800, 6423),
    },
    "DroQ": {
        "Ant": (3814, 5965),
        "HalfCheetah": (8735, 11070),
        "Hopper": (2607, 2798),
        "Humanoid": (3404, 5380),
        "Walker2d": (3848, 4782),
    },
    "MR.Q": {
        "Ant": (4224, 6809),
        "HalfCheetah": (9981, 13018),
        "Hopper": (2462, 2544),
        "Humanoid": (1309, 10129),
        "Walker2d": (4137, 5896),
    },
    "BRO": {
        "Ant": (4144, 7467),
        "HalfCheetah": (9772, 15420),
        "Hopper": (1770, 1802),
        "Humanoid": (983, 5681),
        "Walker2d": (629, 3036),
    },
    "SimBaV2": {
        "Ant": (5732, 7429),
        "HalfCheetah": (8913, 12022),
        "Hopper": (3144, 4054),
        "Humanoid": (5980, 10546),
        "Walker2d": (3298, 6938),
    },
}
_WIDTHS = {"net_arch": [256, 256]}
SBX: dict[str, dict[str, Any]] = {
    "sbx CrossQ": {"algo": "CrossQ", "settings": {"policy_kwargs": _WIDTHS}},
    "sbx SAC": {"algo": "SAC", "settings": {"policy_kwargs": _WIDTHS}},
    "sbx TQC": {"algo": "TQC", "settings": {"policy_kwargs": _WIDTHS}},
    "sbx SimBa": {"algo": "SAC", "policy": "SimbaPolicy", "settings": {}},
}
"""What sbx trains, with its own defaults but for the widths, which are those of our networks."""


@dataclasses.dataclass(frozen=True)
class Row:
    """An evaluation of a training."""

    environment: str
    tool: str  # rlctl and its algorithm, or a key of `SBX`
    version: str
    seed: int
    budget: int  # steps of the whole training: learning rates may depend on it
    steps: int
    score: float  # mean return of the evaluation
    episodes: int
    minutes: float  # from the start of the training
    cores: int  # that the training had
    command: str

    @classmethod
    def read(cls, row: dict[str, str]) -> Row:
        """Read a row of the file."""
        kinds = {"int": int, "float": float, "str": str}
        return cls(**{field.name: kinds[str(field.type)](row[field.name]) for field in dataclasses.fields(cls)})

    @property
    def training(self) -> tuple[str, str, int, int]:
        """What tells its training from the others."""
        return self.environment, self.tool, self.seed, self.budget


def train(environment: str, tool: str, seed: int, budget: int) -> list[Row]:
    """Train, and return its evaluations; raises `RuntimeError` if the training fails."""
    folder = (FOLDER / f"{environment}_{tool}_{seed}_{budget}".replace(" ", "-")).resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if tool == "rlctl":
        command = [sys.executable, "-m", "rlctl", "train", environment, "--seed", str(seed), "-o", str(folder)]
        settings = {"total_timesteps": budget, "eval.every_steps": EVERY, "eval.episodes": EPISODES}
        command += itertools.chain.from_iterable(("--set", f"{key}={value}") for key, value in settings.items())
        follow(command, list, folder / "log.txt", np.inf)
        return read_run(folder / "latest", available_cores())
    job = {"env": environment, "seed": seed, "steps": budget, "n_envs": 1, "every": EVERY, "folder": str(folder)}
    command = write_sbx(job | {"episodes": EPISODES, "last_episodes": LAST_EPISODES} | SBX[tool], folder)
    evaluations = follow(command, lambda: read_evaluations(folder), folder / "log.txt", np.inf)
    curve = [(EVERY * number, score, minutes) for number, (minutes, score) in enumerate(evaluations, start=1)]
    shared = environment, tool, read_version("sbx"), seed, budget
    last = float((folder / "last.txt").read_text())
    return _make_rows(shared, curve, last, available_cores(), describe_command(command, folder))


def _make_rows(
    training: tuple[str, str, str, int, int],
    curve: list[tuple[int, float, float]],
    last: float,
    cores: int,
    command: str,
) -> list[Row]:
    """Return a row for each evaluation: steps, score and minutes; `last` is the score of the policy at the end."""
    *before, (steps, _, minutes) = curve
    evaluations = [(*one, EPISODES) for one in before] + [(steps, last, minutes, LAST_EPISODES)]
    return [
        Row(*training, steps, round(score, 1), episodes, round(minutes, 2), cores, command)
        for steps, score, minutes, episodes in evaluations
    ]


def read_run(folder: Path, cores: int) -> list[Row]:
    """Return the evaluations of a run of rlctl; raises `RuntimeError` unless it has finished."""
    run = RunDirectory(folder)
    status, recipe = run.status(), run.recipe()
    if status.get("status") != "finished":
        raise RuntimeError(f"{folder}: the training has not finished")
    is_averaged = fill_parameters(recipe).get("actor_average", True)  # only some algorithms can be
    tool = f"rlctl {recipe.algo}" + ("" if is_averaged else NOT_AVERAGED)
    shared = status["task"], tool, read_version("rlctl"), recipe.seed, recipe.total_timesteps
    curve = [(int(row["steps"]), float(row["return"]), float(row["seconds"]) / 60) for row in read_csv(run.evals_file)]
    shown = _describe_command(status, recipe)
    trained = _make_rows(shared, curve, _evaluate(folder, "last"), cores, shown)
    best = dataclasses.replace(trained[-1], tool=f"{trained[-1].tool}{KEPT}", score=round(_evaluate(folder, "best"), 1))
    return [*trained, best]


def _evaluate(folder: Path, checkpoint: str) -> float:
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        options = ["--checkpoint", checkpoint, "--episodes", str(LAST_EPISODES), "--json", file.name]
        rlctl_command("eval", str(folder.resolve()), *options)
        return float(json.loads(Path(file.name).read_text())["return"]["mean"])


def _describe_command(status: dict[str, Any], recipe: Recipe) -> str:
    """Return the command without folders of this machine, and without a file that says what the preset says."""
    if recipe == sources.resolve(status["task"], None, {"seed": recipe.seed}):
        return f"rlctl train {status['task']} --seed {recipe.seed}"
    words = list(status["command"])
    for option, shown in (("-o", "FOLDER"), ("--resume", "FOLDER"), ("--config", "FILE")):
        if option in words:
            words[words.index(option) + 1] = shown
    return shlex.join(words)


def write_page(rows: list[Row]) -> None:
    """Write the tables of all trainings after each of `BUDGETS`."""
    lines = [
        "# Gymnasium's MuJoCo robots after 200,000 and 1,000,000 steps\n",
        f"Written by `python -m tests.benchmarks.mujoco_scores` on {describe_machine()}, from [every evaluation]"
        f"({ROWS.name}) of what was trained so far, of all seeds: interquartile mean of the seeds' mean",
        f"returns of {LAST_EPISODES} episodes of the policy at the end, its 95 % interval from {_LEAST_FOR_INTERVAL}",
        f"seeds on, else their range; before the end, in the picture, {EPISODES} episodes. *Best policy*: that of the",
        "best evaluation, which rlctl keeps, plays and exports; its return is of new episodes.",
        "A training learns for as many steps as its budget. With one core its minutes are an upper bound: others",
        "computed beside it. *Published* are means of ten seeds on v4, computed from",
        "the curves of the authors, most with networks many times as wide.\n",
        f"![return over steps](pictures/{PICTURE.name})",
    ]
    for budget in BUDGETS:
        lines += [
            f"\n## {budget:,} steps\n",
            "| robot | trained by | seeds | return | of each seed | minutes | cores |",
            "|---|---|---|---|---|---|---|",
        ]
        for environment in sorted({row.environment for row in rows}):
            lines += _list_trained([row for row in rows if row.environment == environment], budget)
            robot = environment.partition("-")[0]
            known = [
                f"{name} {means[robot][BUDGETS.index(budget)]:,}" for name, means in PUBLISHED.items() if robot in means
            ]
            if known:
                lines.append(f"| `{environment}` | *published* | 10 | {', '.join(known)} | | | |")
    commands = dict.fromkeys(f"- {row.tool}: `{row.command}`" for row in rows)
    files.write_text(PAGE, "\n".join([*lines, "\n## The commands\n", *commands, ""]))


def _list_trained(rows: list[Row], budget: int) -> list[str]:
    lines = []
    for tool in sorted({row.tool for row in rows}):
        ends = [row for row in rows if (row.tool, row.budget) == (tool, budget) and row.steps >= budget]
        if not ends:
            continue
        ends.sort(key=lambda row: row.seed)
        scores = np.array([row.score for row in ends])
        low, high = interquartile_mean_interval(scores) or (scores.min(), scores.max())
        middle = f"{Spread.of(scores.tolist()).iqm:,.0f}"
        if len(scores) > 1:
            middle += f" ({low:,.0f} to {high:,.0f})"
        each = ", ".join(f"{row.seed}: {row.score:,.0f}" for row in ends)
        minutes = float(np.median([row.minutes for row in ends]))
        cores = ", ".join(sorted({str(row.cores) for row in ends}))
        lines.append(
            f"| `{ends[0].environment}` | {tool} | {len(ends)} | {middle} | {each} | {minutes:.0f} | {cores} |"
        )
    return lines


def draw(rows: list[Row], target: Path) -> None:
    """Draw the return over steps, a panel per robot and a line per training."""
    from matplotlib.figure import Figure

    rows = [row for row in rows if not row.tool.endswith(KEPT)]
    environments, tools = sorted({row.environment for row in rows}), sorted({row.tool for row in rows})
    columns = min(3, len(environments))
    height = -(-len(environments) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.8 * height), layout="constrained")
    lines = {}
    for number, environment in enumerate(environments, start=1):
        axes = figure.add_subplot(
            height, columns, number, title=environment, xlabel="steps [thousands]", ylabel="return"
        )
        for training in sorted({row.training for row in rows if row.environment == environment}):
            curve = sorted((row.steps / 1000, row.score) for row in rows if row.training == training)
            (lines[training[1]],) = axes.plot(*zip(*curve, strict=True), color=f"C{tools.index(training[1])}")
    figure.legend(lines.values(), lines, frameon=False, loc="outside lower center", ncols=len(lines))
    figure.savefig(target, dpi=110)


def read_rows() -> list[Row]:
    """Return all evaluations that are kept."""
    return [Row.read(row) for row in read_csv(ROWS)] if ROWS.exists() else []


def keep(trained: list[Row]) -> None:
    """Add the evaluations of a training to those that are kept, instead of those of an earlier equal training."""
    known = {row.training for row in trained}
    rows = [row for row in read_rows() if row.training not in known] + trained
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in dataclasses.fields(Row))
    writer.writerows(dataclasses.astuple(row) for row in sorted(rows, key=lambda row: (row.training, row.steps)))
    files.write_text(ROWS, text.getvalue())


def main() -> int:
    """Train, keep the evaluations, and write the page and the picture."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.mujoco_scores", description=__doc__)
    parser.add_argument("environments", nargs="*", help="ids of Gymnasium; default: only write the page")
    parser.add_argument("--tools", nargs="*", default=["rlctl"], choices=["rlctl", *SBX])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--steps", type=int, default=BUDGETS[0], choices=BUDGETS)
    parser.add_argument("--add", type=Path, nargs="*", default=[], help="finished runs of rlctl")
    parser.add_argument("--cores", type=int, default=available_cores(), help="that those runs had; default: all")
    options = parser.parse_args()
    if set(options.tools) & set(SBX) and PEERS["sbx"] not in os.environ:
        parser.error(f"set {PEERS['sbx']} to a Python with sbx and rlctl, or give --tools rlctl")
    for folder in options.add:
        keep(read_run(folder, options.cores))
    for environment, seed, tool in itertools.product(options.environments, options.seeds, options.tools):
        print(f"{environment} {tool} seed {seed}", file=sys.stderr, flush=True)
        keep(train(environment, tool, seed, options.steps))
    rows = read_rows()
    if not rows:
        parser.error("nothing was trained so far: name an environment, or --add a finished run")
    write_page(rows)
    draw(rows, PICTURE)
    return 0


if __name__ == "__main__":
    try:
        code = main()
    except (RuntimeError, RlctlError) as error:
        print(f"error: {error}", file=sys.stderr)
        code = 1
    sys.exit(code)
