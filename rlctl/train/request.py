"""`rlctl train`: from a request to a finished run."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rlctl.errors import TaskError
from rlctl.run.directory import RunDirectory
from rlctl.train import status
from rlctl.train.display import make_display
from rlctl.train.prepare import prepare
from rlctl.train.signals import StopSignals
from rlctl.train.start import Start, TrainRequest, find_start

if TYPE_CHECKING:
    from rlctl.train.progress import Progress

__all__ = ["TrainRequest", "TrainResult", "run_training"]


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """How a training ended."""

    run: RunDirectory
    task: str
    steps: int
    seconds: float
    """Of training, with what came before a resume."""
    wall_seconds: float
    """From the call to the end: with the start of the workers, the check, imports and saving."""
    best_step: int | None
    best_success: float | None
    best_return: float | None
    eval_episodes: int
    recordings: list[Path] = dataclasses.field(default_factory=list)
    note: str = ""
    stage: int = 0
    """Stage of the curriculum at the end, from 1; 0 where there is none."""
    stages: int = 0


def run_training(request: TrainRequest) -> TrainResult:
    """Train, or go on with a run; returns when it is done. Raises `Interrupted` after a signal."""
    with StopSignals() as signals, find_start(request) as start:
        if start.checkpoint is not None and start.checkpoint.progress.done:
            return _report_finished(start)
        title = f"{'train' if start.run is None else 'resume'} {start.task} ({start.recipe.algo})"
        with make_display(title, start.recipe.total_timesteps) as display, prepare(start, display) as training:
            signals.begin(training)
            training.run()
            signals.end()
            recordings = training.write_end(request.record)
    result = _make_result(training.saver.run, start, training.steps, training.progress)
    return dataclasses.replace(result, recordings=recordings)


def _report_finished(start: Start) -> TrainResult:
    assert start.run is not None  # a checkpoint is of a run
    assert start.checkpoint is not None
    progress = start.checkpoint.progress
    if start.run.status().get("status") == "running":  # killed after all was done
        status.write_end(start.run, start.step, progress)
    note = "this run is finished already: nothing to do; -n makes it longer"
    return dataclasses.replace(_make_result(start.run, start, start.step, progress), note=note)


def _make_result(run: RunDirectory, start: Start, steps: int, progress: Progress) -> TrainResult:
    """Return how a training ended; raises `TaskError` if evaluations failed."""
    if progress.failed_evaluations:
        raise TaskError(
            f"{run.path}: the training is done, but {progress.failed_evaluations} of its evaluations failed, "
            f"the first {progress.first_failure}"
        )
    return TrainResult(
        run,
        start.task,
        steps,
        progress.seconds,
        time.monotonic() - start.began,
        progress.best_step,
        progress.best_success,
        progress.best_return,
        start.recipe.eval.episodes,
        stage=progress.stage,
        stages=len(start.recipe.stages),
    )
