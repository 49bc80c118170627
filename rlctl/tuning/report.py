"""The results of a tuning, on the terminal and as JSON."""

import dataclasses
import math
import shlex
from collections.abc import Mapping
from typing import Any

from rlctl import output
from rlctl.runs.summary import RunSummary, summarize
from rlctl.tuning.space import get_value, list_values
from rlctl.tuning.tuning import Trial, Tuning


def show(tuning: Tuning, json: str | None) -> None:
    """Print the trials, best first, and the next commands; or only JSON for `-`."""
    runs = {trial.number: summarize(run.path) for trial in tuning.trials if (run := tuning.find_run(trial)) is not None}
    if output.present(as_json(tuning, runs), json):
        return
    out = output.out()
    keys = list(dict.fromkeys(dimension.key for step in tuning.steps for dimension in step))
    columns = ("trial", *(key.rpartition(".")[2] for key in keys), "return", "success", "min", "")
    ranked = sorted(tuning.trials, key=_rank, reverse=True)
    own = list_values(tuning.resolve_recipe())
    out.print(f"{tuning.task}: {tuning.path}, by {tuning.metric}; means over the last third of the evaluations")
    output.print_table(
        columns, [_list_cells(tuning, trial, keys, own, runs.get(trial.number)) for trial in ranked], left=("",)
    )
    best = tuning.best
    assert best is not None
    task, file = shlex.quote(tuning.task), shlex.quote(str(tuning.best_file))
    if best.number == 0:
        out.print("no trial was better than the unchanged recipe")
        return
    seeds = f"{tuning.seed + 100}-{tuning.seed + 104}"
    out.print(
        f"best: trial {best.number}, in {tuning.best_file}\n"
        f"Each trial had one seed, so the best of {len(tuning.trials)} looks better than it is. Compare on new seeds:\n"
        f"  rlctl train {task} --config {file} --seeds {seeds}\n"
        f"  rlctl train {task} --seeds {seeds}\n"
        "then give both groups to rlctl runs compare"
    )


def _rank(trial: Trial) -> tuple[bool, float]:
    return trial.state == "done", -math.inf if trial.score is None else trial.score


def _list_cells(
    tuning: Tuning, trial: Trial, keys: list[str], own: Mapping[str, Any], run: RunSummary | None
) -> tuple[str, ...]:
    notes = {
        "done": "",
        "failed": f"failed: {trial.problem}",
        "begun": f"not finished: {trial.problem or 'interrupted'}",
    }
    total, success = tuning.measure(trial, "return"), tuning.measure(trial, "success")
    seconds = None if run is None else run.seconds
    return (
        str(trial.number),
        *(str(trial.values.get(key, get_value(own, key))) for key in keys),
        "-" if total is None else f"{total:.4g}",
        "-" if success is None else f"{success:.1%}",
        "-" if seconds is None else f"{seconds / 60:.1f}",
        "recipe" if trial.number == 0 and trial.state == "done" else notes.get(trial.state, trial.state),
    )


def as_json(tuning: Tuning, runs: dict[int, RunSummary]) -> dict[str, Any]:
    """Return every trial, with its run, as plain data."""
    trials = [
        {**dataclasses.asdict(trial), "run": runs[trial.number].path if trial.number in runs else None}
        for trial in tuning.trials
    ]
    best = tuning.best
    return {
        "task": tuning.task,
        "folder": tuning.path,
        "metric": tuning.metric,
        "best": None if best is None else best.number,
        "best_recipe": tuning.best_file,
        "trials": trials,
    }
