"""`rlctl runs`: every run below ./runs, newest first."""

import dataclasses
import glob
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.environments import registry
from rlctl.errors import ArtifactError, did_you_mean, short_repr
from rlctl.run.directory import ROOT, RunDirectory, is_group
from rlctl.run.group import find_group, read_group
from rlctl.run.lookup import describe_source_change, find_run
from rlctl.runs.summary import RunSummary, find_runs, list_waiting, summarize

_SORT_KEYS = {
    "newest": lambda run: (run.started or run.path.name, run.path.name),
    "score": lambda run: run.score,
    "steps": lambda run: run.steps or 0,
    "minutes": lambda run: run.seconds or 0.0,
}
_COLUMNS = ("run", "algo", "seed", "state", "steps", "minutes", "success", "return", "differs from the recipe")
_LEFT = ("run", "algo", "state", "differs from the recipe")
_DROP = ("minutes", "algo", "seed", "steps", "return", "success", "differs from the recipe")
"""Columns that a narrow terminal omits, in this order."""
_CHANGES_SHOWN = 4
_WIDE = 100  # columns; a narrower table has no reason of a failure
_STATE_SHOWN = 44  # characters; `rlctl runs show` has the whole error


def list_runs(
    task: str | None = None,
    *,
    sort: str = "newest",
    root: Path = ROOT,
    commands: Iterable[str] = (),
    waiting: bool = False,
) -> list[RunSummary]:
    """Return the runs of a task, or all; with `waiting` also those that a cluster has not begun.

    Raises `ArtifactError` for a task without runs; the error suggests similar tasks and `commands`.
    """
    runs = [*(summarize(path) for path in find_runs(root)), *(list_waiting(root) if waiting else ())]
    if task is not None:
        slug = registry.make_slug(task)
        named = [run for run in runs if run.task == task or run.name.partition("/")[0] == slug]
        if not named:
            names = sorted({run.task for run in runs})
            close = did_you_mean(task, [*names, *commands])
            raise ArtifactError(
                f"no run of {task!r} under {root.resolve()}, and rlctl runs has no such command.{close}"
            )
        runs = named
    return sorted(runs, key=_SORT_KEYS[sort], reverse=True)


def find_runs_of(text: str) -> list[RunDirectory]:
    """Return the runs that an argument names: those of a glob, a group or a folder of runs, or one run."""
    if any(character in text for character in "*?[") and not Path(text).exists():
        runs = [RunDirectory(path) for path in map(Path, sorted(glob.glob(text))) if (path / "run.json").is_file()]
        if not runs:
            raise ArtifactError(f"{text}: no run matches")
        return runs
    path = Path(text)
    if not is_group(path) and not (path / "run.json").exists() and (files := sorted(path.rglob("run.json"))):
        return [RunDirectory(file.parent) for file in files]  # `latest` is a link, so its run is there only once
    if (folder := find_group(text)) is None:
        return [find_run(text)]
    group = read_group(folder)
    runs = [run for seed in group.seeds if (run := group.find_run(seed)) is not None]
    if not runs:
        raise ArtifactError(f"{text}: none of its seeds has started")
    return runs


def show(runs: list[RunSummary], json: str | None) -> None:
    """Print the table, or JSON alone for `-`."""
    if output.present({"runs": [as_json(run) for run in runs]}, json):
        return
    out = output.out()
    if not runs:
        out.print(f"no runs yet under {ROOT.resolve()}; train one: rlctl train reach")
        return
    output.print_table(_COLUMNS, map(_cells, runs), left=_LEFT, drop=_DROP)
    for change, names in _find_source_changes(runs).items():
        out.print(f"warning: {change}, in: {', '.join(names)}")


def _find_source_changes(runs: list[RunSummary]) -> dict[str, list[str]]:
    """Return the names of the runs whose task has changed since they began, by what has changed."""
    changes: dict[str, list[str]] = {}
    for run in runs:
        if run.source_sha256 and (change := describe_source_change(RunDirectory(run.path))):
            changes.setdefault(change, []).append(run.name)
    return changes


def _cells(run: RunSummary) -> list[Any]:
    from rich.text import Text

    state = run.state_text if output.out().width >= _WIDE else run.state
    styles = {"done": "green", "queued": "cyan", "running": "cyan", "failed": "red", "damaged": "red"}
    return [
        run.name,
        run.algo,
        "" if run.seed is None else str(run.seed),
        Text(short_repr(state, _STATE_SHOWN), style=styles.get(run.state, "")),
        "" if run.steps is None else f"{run.steps:,}",
        "" if run.seconds is None else f"{run.seconds / 60:.1f}",
        "" if run.best_success is None else f"{run.best_success:.1%}",
        "" if run.best_return is None else f"{run.best_return:.2f}",
        format_changes(run.changes),
    ]


def format_changes(changes: dict[str, Any]) -> str:
    """Return recipe changes as `key=value`, the first few of them."""
    first = list(changes.items())[:_CHANGES_SHOWN]
    shown = [
        f"{len(value)} stages"
        if key == "stages" and value
        else f"{key.removeprefix('algo_kwargs.').removeprefix('policy_kwargs.')}={value}"
        for key, value in first
    ]
    more = len(changes) - len(shown)
    return " ".join(shown) + (f" and {more} more" if more > 0 else "")


def as_json(run: RunSummary) -> dict[str, Any]:
    """Return a summary as plain data."""
    return {**dataclasses.asdict(run), "path": str(run.path), "name": run.name}
