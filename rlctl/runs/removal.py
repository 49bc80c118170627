"""`rlctl runs rm` and `prune`: free the disk without losing what is still wanted."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.filesize import decimal as format_bytes

from rlctl import output
from rlctl.errors import ArtifactError, UsageError
from rlctl.run.directory import ROOT, RunDirectory, is_being_written, is_group
from rlctl.runs.listing import list_runs
from rlctl.runs.selection import find_runs_of
from rlctl.runs.summary import RunSummary, summarize


@dataclasses.dataclass(frozen=True)
class Removal:
    """Folders that are to go, and their size."""

    paths: list[Path]
    bytes: int


def plan_removal(runs: Sequence[str], *, keep_best: int | None = None, root: Path = ROOT) -> Removal:
    """Find the runs to remove: those given, or per task all but the `keep_best` best that are finished or failed.

    The seeds of a group are left out of `keep_best`.

    Raises `UsageError` where nothing or both is asked for, or a run is being trained; `ArtifactError` for a folder that
    is not a run.
    """
    if bool(runs) == (keep_best is not None) or "" in runs:  # a variable of the shell that is not set
        raise UsageError("say what to remove: RUN..., or --keep-best N for all but the N best of each task")
    if keep_best is not None:
        return _measured([run.path for run in _all_but_best(list_runs(root=root), keep_best)])
    paths = [_checked(Path(text), root) for text in runs]
    for path in paths:
        if any(is_being_written(folder) for folder in (path, *(lock.parent for lock in path.glob("*/.lock")))):
            raise UsageError(f"{path}: this run is being trained; nothing was removed")
    return _measured(list(dict.fromkeys(paths)))


def _checked(path: Path, root: Path) -> Path:
    """Return a run's folder; only a folder with a run.json of ours, or a damaged one where runs are, is one."""
    below = root / path
    folder = path if path.is_dir() else below
    is_run = (folder / "run.json").is_file()
    is_below_root = folder.resolve().parent.parent == root.resolve() and folder.is_dir()
    if folder.is_symlink() or not (is_run or is_below_root):
        raise ArtifactError(f"{path}: not the folder of a run; `rlctl runs` lists them")
    if is_run and not is_below_root:
        RunDirectory(folder).status()
    return folder.resolve()


def _all_but_best(runs: list[RunSummary], count: int) -> list[RunSummary]:
    # The seeds of a group stay together: without those that did worse it would say of its recipe what is not true.
    alone = [run for run in runs if not is_group(run.path.parent)]
    ended = [run for run in alone if run.state in ("done", "failed") and not is_being_written(run.path)]
    by_task: dict[str, list[RunSummary]] = {}
    for run in sorted(ended, key=lambda run: run.score, reverse=True):
        by_task.setdefault(run.task, []).append(run)
    return [run for task in by_task.values() for run in task[count:]]


def plan_prune(runs: Sequence[str] = (), root: Path = ROOT) -> Removal:
    """Find the checkpoints, replay buffers included, of finished runs; they are needed only to train on.

    `runs` are runs, groups, globs or folders of runs; by default all. Raises `UsageError` for one of these that has not
    finished.
    """
    named = [summarize(run.path) for text in runs for run in find_runs_of(text)]
    for run in named:
        if run.state != "done":
            raise UsageError(f"{run.path}: {run.state}; only a finished run can do without its checkpoints")
    candidates = named if runs else [run for run in list_runs(root=root) if run.state == "done"]
    folders = [RunDirectory(run.path).checkpoint(0).parent for run in candidates if not is_being_written(run.path)]
    return _measured([folder for folder in folders if folder.is_dir()])


def _measured(paths: list[Path]) -> Removal:
    size = sum(file.lstat().st_size for path in paths for file in path.rglob("*") if not file.is_dir())
    return Removal(paths, size)


def remove_with_report(removal: Removal, *, yes: bool, dry_run: bool = False) -> None:
    """List what is to go and its size, ask, remove, and say what came free; `dry_run` only lists.

    Raises `UsageError` where nobody can be asked and `yes` is not set.
    """
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
    out.print(f"removed {what}: {format_bytes(removal.bytes)} came free")


def remove(removal: Removal) -> None:
    """Remove the folders; each under another name first, so that a half-removed one is not taken for a run.

    Raises `UsageError` for a run that is being trained by now: the question may have waited long for its answer.
    """
    for path in removal.paths:
        if is_being_written(path if (path / ".lock").exists() else path.parent):
            raise UsageError(f"{path}: this run is being trained; it was not removed")
        beside = path.with_name(f".{path.name}.removed")
        try:
            path.rename(beside)
            shutil.rmtree(beside)
        except OSError as error:
            raise ArtifactError(f"{path}: cannot be removed: {error.strerror}") from None
