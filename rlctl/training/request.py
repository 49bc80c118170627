"""`rlctl train`: from a request to a finished run."""

import dataclasses
import time
from pathlib import Path

from rlctl.errors import ArtifactError, TaskError
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.processes.printed_lines import write_stderr
from rlctl.recipe.recipe import Recipe
from rlctl.run.directory import RunDirectory
from rlctl.run.train_request import TrainRequest
from rlctl.training import status
from rlctl.training.display import make_display
from rlctl.training.progress import Progress
from rlctl.training.setup import set_up
from rlctl.training.signals import StopSignals
from rlctl.training.start import Start, find_start
from rlctl.training.tracking import track


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """How a training ended."""

    run: RunDirectory
    task: str
    recipe: Recipe
    steps: int
    progress: Progress
    """Stage of the curriculum, and seconds of training, including those before a resume."""
    best: PolicyInfo | None
    """The best policy with its score; None if no evaluation could be played."""
    wall_seconds: float
    """Duration of the call [s], including start of workers, check, imports and saving."""
    recordings: list[Path] = dataclasses.field(default_factory=list)
    note: str = ""

    def __repr__(self) -> str:
        return f"TrainResult({self.task}, {self.recipe.algo}, {self.steps:,} steps, run {str(self.run.path)!r})"


def run_training(request: TrainRequest) -> TrainResult:
    """Train or resume; returns when the training is done.

    Raises `Interrupted` after a signal, and `TaskError` if evaluations failed.
    """
    with StopSignals() as signals, find_start(request) as start:
        if start.run is not None and start.checkpoint is not None and start.checkpoint.progress.done:
            return _report_finished(start, start.run, start.checkpoint.progress)
        title = f"{'train' if start.run is None else 'resume'} {start.task} ({start.recipe.algo})"
        with make_display(title, start.recipe.total_timesteps) as display, set_up(start, display) as training:
            signals.begin(training)
            training.run()
            signals.end()
            recordings = training.write_end(request.record)
    run, progress = training.checkpoints.run, training.learner.progress
    _raise_if_evaluations_failed(run, progress)
    seconds = time.monotonic() - start.began
    best, steps = training.evaluator.best, training.learner.steps
    return TrainResult(run, start.task, start.recipe, steps, progress, best, seconds, recordings)


def _report_finished(start: Start, run: RunDirectory, progress: Progress) -> TrainResult:
    best = _read_best(run)
    if run.status().get("status") != "finished":  # killed before the end was written
        status.write_end(run, start.step, progress, best)
    if start.recipe.track is not None:
        with track(run, start.recipe.track, write_stderr):
            pass  # sends what the tracker has not received yet
    _raise_if_evaluations_failed(run, progress)
    note = "this run has finished: nothing to do; to train longer, give -n"
    if start.request.record:
        note += f"; to record episodes: rlctl replay {run.path}"
    seconds = time.monotonic() - start.began
    return TrainResult(run, start.task, start.recipe, start.step, progress, best, seconds, note=note)


def _read_best(run: RunDirectory) -> PolicyInfo | None:
    try:
        return PolicyFile.read_info(run.best_policy)
    except ArtifactError:
        return None


def _raise_if_evaluations_failed(run: RunDirectory, progress: Progress) -> None:
    if progress.failed_evaluations:
        raise TaskError(
            f"{run.path}: the training is done, but {progress.failed_evaluations} of its evaluations failed, "
            f"the first {progress.first_failure}"
        )
