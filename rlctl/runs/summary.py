"""The summary of a run, read from the small files of its folder; a damaged folder has a summary too."""

import contextlib
import dataclasses
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlctl.errors import ArtifactError
from rlctl.runs.best import find_best_row
from rlctl.runs.directory import ROOT, RunDirectory, is_being_written, is_group
from rlctl.runs.group import find_run_of_seed, list_jobs, read_job
from rlctl.runs.tables import LARGEST, last_row, read_table


@dataclasses.dataclass(frozen=True)
class RunSummary:
    """A line of `rlctl runs`. Numbers are None until the run has them."""

    path: Path
    task: str = ""
    algo: str = ""
    seed: int | None = None
    state: str = ""  # `done`, `queued`, `running`, `stopped`, `failed` or `damaged`
    reason: str = ""  # why it failed or is damaged; where a cluster executes it
    started: str = ""  # ISO 8601, UTC
    steps: int | None = None
    seconds: float | None = None  # spent training [s]
    best_step: int | None = None
    best_success: float | None = None
    best_return: float | None = None
    changes: dict[str, Any] = dataclasses.field(default_factory=dict)  # recipe keys that differ from the task's
    changed_from: dict[str, Any] = dataclasses.field(default_factory=dict)  # the task's values of these keys
    versions: dict[str, str] = dataclasses.field(default_factory=dict)
    folder: str = ""  # the working folder of the training; a relative path of a task starts there
    source_sha256: str = ""  # of the task's file when the training began

    @property
    def name(self) -> str:
        """Return the path below the folder of all runs: `reach/2026-11-21_10-30-00_s0`."""
        path = self.path.resolve()  # the path may be "." or "latest"
        return "/".join(path.parts[-3 if is_group(path.parent) else -2 :])

    @property
    def state_text(self) -> str:
        """Return the state in words, with the step it stopped at or the reason."""
        if self.state == "stopped":
            return f"stopped at step {self.steps or 0:,}"
        return f"{self.state}: {self.reason}" if self.reason else self.state

    @property
    def score(self) -> tuple[float, float]:
        """Return what to rank runs of one task by: success first, then return."""
        success, mean_return = self.best_success, self.best_return
        return -math.inf if success is None else success, -math.inf if mean_return is None else mean_return


def find_runs(root: Path = ROOT) -> Iterator[Path]:
    """Yield every run folder below `root`, damaged ones included: all folders two levels down, and those in groups."""
    for task in _folders(root):
        for folder in _folders(task):
            yield from _folders(folder) if is_group(folder) else [folder]


def _folders(path: Path) -> list[Path]:
    try:
        with os.scandir(path) as entries:
            own = [entry for entry in entries if not entry.name.startswith(".")]
            return [Path(entry.path) for entry in own if entry.is_dir(follow_symlinks=False)]
    except OSError:
        return []


def summarize(path: Path) -> RunSummary:
    """Read one run; never raises for what is in the folder."""
    run = RunDirectory(path)
    try:
        return _summarize(run, run.status())
    except (ArtifactError, OSError, ValueError, TypeError, KeyError) as error:
        problem = str(error).partition("\n")[0].removeprefix(f"{path}/")
        reason = problem if run.status_file.is_file() else "no run.json"
        return RunSummary(path, task=path.parent.name, state="damaged", reason=reason)


def _summarize(run: RunDirectory, status: dict[str, Any]) -> RunSummary:
    last = last_row(run.metrics_file) or {}
    evaluations = read_table(run.evals_file)
    best = find_best_row(evaluations)
    if status.get("status") == "finished":  # new episodes may have selected the last policy
        best = next((row for row in evaluations if row["steps"] == status.get("best_step")), best)
    state, reason = _state(run, status)
    steps = _first_number(last.get("steps", status.get("steps")))
    if last and steps is None:
        raise ArtifactError(f"{run.metrics_file.name}: its last row has no number of steps")
    if state == "stopped" and (checkpoints := run.checkpoints()):
        steps = max(steps or 0.0, float(checkpoints[-1].name))  # an interrupted training saves after its last row
    return RunSummary(
        path=run.path,
        task=status["task"],
        algo=str(status.get("algo", "")),
        seed=_whole(_first_number(status.get("seed"))),
        state=state,
        reason=reason,
        started=str(status.get("started", "")),
        steps=_whole(steps),
        seconds=_first_number(status.get("seconds"), last.get("seconds")),
        best_step=_whole(best["steps"]) if best else None,
        best_success=best["success"] if best else None,
        best_return=best["return"] if best else None,
        changes=dict(status.get("recipe_changes") or {}),
        changed_from=dict(status.get("recipe_before") or {}),
        versions=dict(status.get("versions") or {}),
        folder=str(status.get("folder") or ""),
        source_sha256=str(status.get("source_sha256") or ""),
    )


def _first_number(*values: object) -> float | None:
    """Return the first value that is a number, or the text of one, and below `LARGEST`."""
    for value in values:
        with contextlib.suppress(ValueError, OverflowError, TypeError):
            if abs(number := float(value)) < LARGEST:  # type: ignore[arg-type]
                return number
    return None


def _whole(number: float | None) -> int | None:
    return None if number is None else int(number)


def _state(run: RunDirectory, status: dict[str, Any]) -> tuple[str, str]:
    state = status.get("status")
    if state == "finished":
        return "done", ""
    if state == "running" and is_being_written(run.path):  # the lock of a killed training is free
        return "running", ""
    if state not in ("running", "interrupted"):
        return "failed", str(status.get("error") or "").partition("\n")[0]
    seed = _whole(_first_number(status.get("seed")))
    job = None if seed is None else read_job(run.path.parent, seed)  # of a run that a cluster executes or will resume
    return ("stopped", "") if job is None or job.state == "ended" else (job.state, job.describe())


def list_waiting(root: Path = ROOT) -> Iterator[RunSummary]:
    """Yield the runs that a cluster has not begun: they have no folder yet, only the one of their group."""
    for task in _folders(root):
        for folder in _folders(task):
            for job in list_jobs(folder):
                if find_run_of_seed(folder, job.seed) is None:
                    path = folder / f"(seed {job.seed})"
                    yield RunSummary(path, task=job.task, seed=job.seed, state=job.state, reason=job.describe())
