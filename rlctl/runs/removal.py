"""`rlctl runs rm` and `prune`: remove runs, or the checkpoints of finished runs."""

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.filesize import decimal as format_bytes

from rlctl import output
from rlctl.errors import ArtifactError, UsageError
from rlctl.run.directory import ROOT, RunDirectory, is_being_written, is_group
from rlctl.runs.listing import find_runs_of, list_runs
from rlctl.runs.summary import RunSummary, summarize


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
    # A group stays whole: without its worse seeds its recipe would look better than it is.
    alone = [run for run in runs if not is_group(run.path.parent)]
    ended = [run for run in alone if run.state in ("done", "failed") and not is_being_written(run.path)]
    by_task: dict[str, list[RunSummary]] = {}
    for run in sorted(ended, key=lambda run: run.score, reverse=True):
        by_task.setdefault(run.task, []).append(run)
    return [run for task in by_task.values() for run in task[count:]]


def plan_prune(runs: Sequence[str] = (), root: Path = ROOT) -> Removal:
    """Find the checkpoints of finished runs, by default of all; they are needed only to train longer.

    Raises `UsageError` for a named run that has not finished.
    """
    named = [summarize(run.path) for text in runs for run in find_runs_of(text)]
    for run in named:
        if run.state != "done":
            raise UsageError(f"{run.path}: {run.state}; only the checkpoints of finished runs can be removed")
    candidates = named if runs else [run for run in list_runs(root=root) if run.state == "done"]
    folders = [RunDirectory(run.path).checkpoint(0).parent for run in candidates if not is_being_written(run.path)]
    return _measure([folder for folder in folders if folder.is_dir()])


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
            raise ArtifactError(f"{path}: cannot be removed: {error.strerror}") from None
