"""`rlctl runs`, `rm` and `prune`: list every run below ./runs, remove runs, or the checkpoints of finished runs."""

import dataclasses
import glob
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.filesize import decimal as format_bytes
from rich.text import Text

from rlctl import output
from rlctl.environments import registry
from rlctl.errors import ArtifactError, UsageError, did_you_mean, short_repr
from rlctl.runs.directory import ROOT, RunDirectory, is_being_written, is_group
from rlctl.runs.group import find_group, read_group
from rlctl.runs.lookup import describe_source_change, find_run
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
        known = [*sorted({run.task for run in runs}), *commands]
        slug = registry.make_slug(task)
        runs = [run for run in runs if run.task == task or run.name.partition("/")[0] == slug]
        if not runs:
            close = did_you_mean(task, known)
            raise ArtifactError(f"no run of {task!r} under {root.resolve()}; rlctl runs has no such command.{close}")
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


def show(runs: list[RunSummary], json: str | None, root: Path = ROOT) -> None:
    """Print the table, or JSON alone for `-`."""
    if output.present({"runs": [as_json(run) for run in runs]}, json):
        return
    out = output.out()
    if not runs:
        out.print(f"no runs yet under {root.resolve()}; train one: rlctl train reach")
        return
    output.print_table(_COLUMNS, map(_cells, runs), left=_LEFT, drop=_DROP)
    changed: dict[str, list[str]] = {}  # what has changed in a task since runs began -> names of the runs
    for run in runs:
        if run.source_sha256 and (change := describe_source_change(RunDirectory(run.path))):
            changed.setdefault(change, []).append(run.name)
    for change, names in changed.items():
        out.print(f"warning: {change}, in: {', '.join(names)}")


def _cells(run: RunSummary) -> list[Any]:
    state = run.state_text if output.out().width >= _WIDE else run.state
    styles = {"done": "green", "queued": "cyan", "running": "cyan", "failed": "red", "damaged": "red"}
    minutes = None if run.seconds is None else run.seconds / 60
    numbers = ((run.steps, ","), (minutes, ".1f"), (run.best_success, ".1%"), (run.best_return, ".2f"))
    return [
        run.name,
        run.algo,
        "" if run.seed is None else str(run.seed),
        Text(short_repr(state, _STATE_SHOWN), style=styles.get(run.state, "")),
        *("" if number is None else format(number, form) for number, form in numbers),
        format_changes(run.changes),
    ]


def format_changes(changes: dict[str, Any]) -> str:
    """Return recipe changes as `key=value`, the first few of them."""
    shown = [
        f"{len(value)} stages"
        if key == "stages" and value
        else f"{key.removeprefix('algo_kwargs.').removeprefix('policy_kwargs.')}={value}"
        for key, value in list(changes.items())[:_CHANGES_SHOWN]
    ]
    more = len(changes) - len(shown)
    return " ".join(shown) + (f" and {more} more" if more > 0 else "")


def as_json(run: RunSummary) -> dict[str, Any]:
    """Return a summary as plain data."""
    return {**dataclasses.asdict(run), "path": str(run.path), "name": run.name}


@dataclasses.dataclass(frozen=True)
class Removal:
    """Folders to remove, and their size."""

    paths: list[Path]
    bytes: int


def plan_removal(runs: Sequence[str], *, keep_best: int | None = None, root: Path = ROOT) -> Removal:
    """Find the runs to remove: those named, or of each task all finished or failed runs except the `keep_best` best.

    `keep_best` never removes the runs of a group. Raises `UsageError` if a run is being trained.
    """
    if bool(runs) == (keep_best is not None) or "" in runs:  # an unset variable of the shell
        raise UsageError("give RUN..., or --keep-best N to remove all but the N best of each task")
    if keep_best is not None:
        return _measure([run.path for run in _all_but_best(list_runs(root=root), keep_best)])
    paths = [_resolve_run_folder(Path(text), root) for text in runs]
    for path in paths:
        if any(is_being_written(folder) for folder in (path, *(lock.parent for lock in path.glob("*/.lock")))):
            raise UsageError(f"{path}: this run is being trained; nothing was removed")
    return _measure(list(dict.fromkeys(paths)))


def _resolve_run_folder(path: Path, root: Path) -> Path:
    """Return the folder of a run: one with a run.json of rlctl, or a damaged one two levels below `root`."""
    folder = path if path.is_dir() else root / path
    is_run = (folder / "run.json").is_file()
    is_below_root = folder.resolve().parent.parent == root.resolve() and folder.is_dir()
    if folder.is_symlink() or not (is_run or is_below_root):
        raise ArtifactError(f"{path}: not the folder of a run; `rlctl runs` lists them")
    if is_run and not is_below_root:
        RunDirectory(folder).status()
    return folder.resolve()


def _all_but_best(runs: list[RunSummary], count: int) -> list[RunSummary]:
    # A group stays whole: without its worse seeds its recipe would look better than it is.
    alone = [run for run in runs if not is_group(run.path.parent)]
    ended = [run for run in alone if run.state in ("done", "failed") and not is_being_written(run.path)]
    by_task: dict[str, list[RunSummary]] = {}
    for run in sorted(ended, key=lambda run: run.score, reverse=True):
        by_task.setdefault(run.task, []).append(run)
    return [run for task in by_task.values() for run in task[count:]]


def plan_prune(runs: Sequence[str] = (), root: Path = ROOT) -> Removal:
    """Find the checkpoints of finished runs, by default of all; they are needed only to train longer.

    A folder of checkpoints that is a link is left out, with a warning: only its owner knows who else uses the target.
    Raises `UsageError` for a named run that has not finished.
    """
    named = [summarize(run.path) for text in runs for run in find_runs_of(text)]
    for run in named:
        if run.state != "done":
            raise UsageError(f"{run.path}: {run.state}; only the checkpoints of finished runs can be removed")
    candidates = named if runs else [run for run in list_runs(root=root) if run.state == "done"]
    folders = [RunDirectory(run.path).checkpoint(0).parent for run in candidates if not is_being_written(run.path)]
    links = [folder for folder in folders if folder.is_symlink()]
    output.print_notes(_describe_link(folder) for folder in links)
    return _measure([folder for folder in folders if folder.is_dir() and folder not in links])


def _describe_link(folder: Path) -> str:
    return f"warning: {folder} is a link and is not removed; its checkpoints are in {folder.resolve()}"


def _measure(paths: list[Path]) -> Removal:
    size = sum(file.lstat().st_size for path in paths for file in path.rglob("*") if not file.is_dir())
    return Removal(paths, size)


def remove_with_report(removal: Removal, *, yes: bool, dry_run: bool = False) -> None:
    """List the folders and their size, ask unless `yes`, and remove them; `dry_run` only lists."""
    out = output.out()
    for path in removal.paths:
        out.print(str(path))
    if not removal.paths:
        out.print("nothing to remove")
        return
    what = output.format_count(len(removal.paths), "folder")
    if dry_run:
        out.print(f"would remove {what}: {format_bytes(removal.bytes)}")
        return
    refusal = "nothing was removed: there is no terminal to ask on; --yes removes without asking"
    if not yes and not output.confirm(f"remove {what}, {format_bytes(removal.bytes)}?", refusal):
        return
    remove(removal)
    out.print(f"removed {what}: {format_bytes(removal.bytes)} freed")


def remove(removal: Removal) -> None:
    """Remove the folders; raises `UsageError` for a run whose training has started since it was listed."""
    for path in removal.paths:
        if is_being_written(path if (path / ".lock").exists() else path.parent):
            raise UsageError(f"{path}: this run is being trained; it was not removed")
        renamed = path.with_name(f".{path.name}.removed")  # a partly removed one is not listed as a run
        try:
            path.rename(renamed)
            shutil.rmtree(renamed)
        except OSError as error:
            raise ArtifactError(f"{path}: cannot be removed: {error.strerror or error}") from None
