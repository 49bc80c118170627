"""`rlctl train`: from a request to a finished run."""

import dataclasses
import shlex
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlctl import output
from rlctl.errors import ArtifactError, TaskError
from rlctl.launching.findings import WarnOfFindings
from rlctl.launching.tracking import SendToTracker, track
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.printed_lines import collect, print_line
from rlctl.recipe.recipe import Recipe
from rlctl.runs.diagnosis.findings import Finding, diagnose, format_end
from rlctl.runs.directory import RunDirectory
from rlctl.runs.train_request import TrainRequest
from rlctl.training import status
from rlctl.training.display import duration, make_display, percent
from rlctl.training.progress import Progress
from rlctl.training.setup import set_up
from rlctl.training.signals import StopSignals
from rlctl.training.start import Start, find_start


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


def run_training(request: TrainRequest, find: Callable[[TrainRequest], Start] = find_start) -> TrainResult:
    """Train or resume to the end. Raises `Interrupted` after a signal, and `TaskError` if evaluations failed.

    `find` returns the start of the request.
    """
    with StopSignals() as signals, find(request) as start:
        if start.run is not None and start.checkpoint is not None and start.checkpoint.state.progress.done:
            return _report_finished(start, start.run, start.checkpoint.state.progress)
        engine = start.env_specs[-1].engine_title
        how = ", ".join(filter(None, [start.recipe.algo, engine]))
        verb = "train" if start.teacher is None else "distill"
        if start.run is not None:
            verb = "resume"
        title = f"{verb} {start.task} ({how})"
        display = make_display(title, start.recipe.total_timesteps)
        observers = [WarnOfFindings(start.request), SendToTracker()]
        with display, collect() as printed, set_up(start, display, printed, observers) as training:
            signals.begin(training)
            training.run()
            signals.end()
            recordings = training.write_end(request.record, _record)
    run, learner, best = training.checkpoints.run, training.learner, training.evaluator.best
    _raise_if_evaluations_failed(run, learner.progress)
    seconds = time.monotonic() - start.began
    return TrainResult(run, start.task, start.recipe, learner.steps, learner.progress, best, seconds, recordings)


def _record(episodes: list[Path]) -> list[Path]:
    """Make recordings of files of episodes; return their paths."""
    if not episodes:
        return []
    from rlctl.play.episode import load_episode
    from rlctl.replaying.reproduce import record_episode

    recordings = []
    for file in episodes:
        recording = file.with_suffix(".rrd")
        title = f"{file.parent.parent.name} / episode {file.stem}"
        record_episode(load_episode(file), recording, title=title, several=len(episodes) > 1)
        recordings.append(recording)
    return recordings


def _report_finished(start: Start, run: RunDirectory, progress: Progress) -> TrainResult:
    try:
        best = PolicyFile.read_info(run.best_policy)
    except ArtifactError:
        best = None
    if run.status().get("status") != "finished":  # killed before the end was written
        status.write_end(run, start.step, progress, best)
    if start.recipe.track is not None:
        with track(run, start.recipe.track, print_line):
            pass  # sends what the tracker has not received yet
    _raise_if_evaluations_failed(run, progress)
    note = "this run has finished: nothing to do; to train longer, give -n"
    if start.request.record:
        note += f"; to record episodes: rlctl replay {run.path}"
    seconds = time.monotonic() - start.began
    return TrainResult(run, start.task, start.recipe, start.step, progress, best, seconds, note=note)


def _raise_if_evaluations_failed(run: RunDirectory, progress: Progress) -> None:
    if count := progress.failed_evaluations:
        failures = f"{count} of its evaluations failed, the first {progress.first_failure}"
        raise TaskError(f"{run.path}: the training is done, but {failures}")


def show(result: TrainResult, json: str | None) -> None:
    """Print the result, what the training's records show, and what to type next; for `--json -` JSON instead."""
    findings = diagnose(result.run)
    if output.present(_to_json(result, findings), json):
        return
    lines = [result.note] if result.note else []
    lines += [*_format_result(result), *format_end(findings, shlex.quote(str(result.run.path)))]
    if not findings and _never_succeeds(result):
        lines.append("no known mistake in the records: --audit, below, tells what was learned instead")
    lines += [f"recording: rerun {shlex.quote(str(path))}" for path in result.recordings]
    if result.recordings:
        lines.append("  without a display, in a browser: rerun --serve-web FILE")
    lines += [f"run: {result.run.path}", "next:", *(f"  {command}" for command in list_next_commands(result))]
    for line in lines:
        output.out().print(line)


def list_next_commands(result: TrainResult) -> list[str]:
    """Return the next commands: export, or for a policy that never succeeded what it has learned instead."""
    run = shlex.quote(str(result.run.path))
    tensorboard = f"tensorboard --logdir {shlex.quote(str(result.run.tensorboard))}"
    second = f"rlctl runs show {run} --audit" if _never_succeeds(result) else f"rlctl export {run} --onnx"
    return [f"rlctl eval {run}", second, f"rlctl replay {run}", tensorboard]


def _never_succeeds(result: TrainResult) -> bool:
    score = result.best.evaluation if result.best else None
    return score is not None and score.success == 0


def _to_json(result: TrainResult, findings: list[Finding]) -> dict[str, Any]:
    progress, stages = result.progress, len(result.recipe.stages)
    score = result.best.evaluation if result.best else None
    return {
        "run": str(result.run.path),
        "task": result.task,
        "steps": result.steps,
        "seconds": round(progress.seconds, 3),
        "wall_seconds": round(result.wall_seconds, 3),
        "best": {
            "step": result.best.training_steps if result.best else None,
            "success_rate": score.success if score else None,
            "mean_return": score.mean_return if score else None,
            "episodes": result.recipe.eval.episodes,
            "policy": str(result.run.best_policy),
        },
        **({"stage": progress.stage, "stages": stages} if stages else {}),
        "findings": findings,
        "recordings": [str(path) for path in result.recordings],
        "note": result.note,
    }


def _format_result(result: TrainResult) -> list[str]:
    progress, stages = result.progress, len(result.recipe.stages)
    line = f"trained {result.task}: {result.steps:,} steps in {duration(progress.seconds)}"
    if result.wall_seconds >= progress.seconds + 3:
        line += f" ({duration(result.wall_seconds)} with start, check and end)"
    lines = [line]
    if result.best is not None and (score := result.best.evaluation) is not None:
        success = "" if score.success is None else f"success {percent(score.success)}, "
        lines.append(
            f"best at step {result.best.training_steps:,}: {success}return {score.mean_return:.2f} "
            f"(mean of {output.format_count(result.recipe.eval.episodes, 'episode')})"
        )
    if stages:
        short = "" if progress.stage == stages else "; evaluations used the last stage, which training did not reach"
        lines.append(f"ended in stage {progress.stage} of {stages}{short}")
    return lines
