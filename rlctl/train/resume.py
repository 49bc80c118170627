"""Where a training starts: at nothing, or at the newest good checkpoint of a run."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.errors import ArtifactError, RecipeError, UsageError
from rlctl.run import files, lookup
from rlctl.run.directory import RunDirectory, RunLock
from rlctl.run.recipe import Recipe, validate
from rlctl.run.task_version import describe_task_changes

if TYPE_CHECKING:
    from rlctl.train.checkpoint import Checkpoint
    from rlctl.train.progress import Progress

_MAY_CHANGE = ("total_timesteps", "stop_success")


@dataclasses.dataclass(frozen=True)
class Start:
    """Where a training starts."""

    task: str
    recipe: Recipe
    run: RunDirectory | None = None
    lock: RunLock | None = None
    checkpoint: Checkpoint | None = None
    notes: tuple[str, ...] = ()
    """Messages for the user, before the first step."""
    source: Mapping[str, Any] | None = None
    """The policy that it began with; see `warm_start.find_source`."""
    inexact: tuple[str, ...] = ()
    """Why the run cannot go on as if it had never stopped, as far as is known before it goes on."""
    began: float = dataclasses.field(default_factory=time.monotonic)

    @property
    def stage(self) -> int:
        """Stage of the curriculum, from 1."""
        return (self.checkpoint.progress.stage or 1) if self.checkpoint else 1


def load_start(word: str | None, settings: Mapping[str, Any], root: Path, *, force: bool) -> Start:
    """Find a run, lock it, and read its newest good checkpoint; nothing is changed yet.

    `settings` are those of the recipe's that may be others now. Raises `UsageError` for any other, and unless
    `force` is given if the task is another one than it was.
    """
    from rlctl.train import checkpoint

    for key in settings:
        if key not in _MAY_CHANGE:
            raise UsageError(f"--resume goes on with the run's own recipe: {key} cannot be changed, only -n")
    run = lookup.find_run(word, root)
    before = run.recipe()
    lock = run.lock()  # before looking: a process that is training removes old checkpoints
    try:
        recipe = validate({**before.model_dump(by_alias=True), **settings}, "recipe")
        before_status = run.status()
        task = lookup.locate_task(_task(before_status, run), run)
        changes = describe_task_changes(before_status, task)
        if changes and not force:
            raise UsageError(
                f"{run.path}: {'; '.join(changes)}. What was learnt may not fit any more; --force goes on all the same"
            )
        run.recover()
        found, damage = checkpoint.read_newest(run)
        start = Start(task, recipe, run, lock, found, _notes(found, damage), before_status.get("from"), tuple(changes))
        return _reopen(start, before) if settings else start
    except BaseException:
        lock.release()
        raise


def _task(content: Mapping[str, Any], run: RunDirectory) -> str:
    task = content["task"]
    if not isinstance(task, str):
        raise ArtifactError(f"{run.status_file}: damaged: its task is {task!r}")
    return task


def _notes(found: Checkpoint | None, damage: list[str]) -> tuple[str, ...]:
    if found is None:
        return ("no checkpoint yet: the training begins at its first step",)
    return tuple(f"warning: {each}; going on from step {found.state.step:,}" for each in damage)


def _reopen(start: Start, before: Recipe) -> Start:
    """Let a training that was done go on, if it is asked for more than it was."""
    found, recipe = start.checkpoint, start.recipe
    if found is None or not found.progress.done:
        return start
    stricter = recipe.stop_success != before.stop_success
    if found.state.step >= recipe.total_timesteps or not (stricter or recipe.total_timesteps > before.total_timesteps):
        return start
    progress = dataclasses.replace(found.progress, done=False, good_in_a_row=0)
    state = found.state.model_copy(update={"progress": progress})
    return dataclasses.replace(start, checkpoint=dataclasses.replace(found, state=state))


def prepare(run: RunDirectory, found: Checkpoint | None, progress: Progress) -> list[str]:
    """Put the run folder back to where the checkpoint has it; return warnings.

    Tables are cut back, checkpoints that are damaged are set aside, and the best policy stays the best there is.
    """
    from rlctl.run.table import Table
    from rlctl.train.episodes import remove_after

    step = found.state.step if found is not None else 0
    for folder in run.checkpoints():
        if int(folder.name) > step:
            files.set_aside(folder)
    remove_after(run, step)
    warnings = []
    for file, size, sha256 in (
        (run.metrics_file, progress.metrics_bytes, progress.metrics_sha256),
        (run.evals_file, progress.evals_bytes, progress.evals_sha256),
    ):
        table = Table(file)
        if not table.cut_back(size):
            warnings.append(
                f"warning: {file}: rows before step {step:,} are gone: it is shorter than the checkpoint says"
            )
        elif size and table.digest() != sha256:
            warnings.append(
                f"warning: {file}: damaged, or edited: rows before step {step:,} are not those that were written"
            )
    return warnings + _read_best_score(run, progress)


def _read_best_score(run: RunDirectory, progress: Progress) -> list[str]:
    """Take the score from the best policy's own file, which may be newer than the checkpoint.

    Return a warning if it is not as good as the checkpoint says.
    """
    from rlctl.run.policy import read_policy

    best_step, problem = progress.best_step, ""
    score = (progress.best_success or 0.0, progress.best_return or 0.0)
    progress.best_success = progress.best_return = progress.best_step = None
    try:
        info, _ = read_policy(run.best_policy)
    except ArtifactError as error:
        problem = str(error)
    else:
        if info.evaluation is not None:
            progress.best_success, progress.best_return = info.evaluation.success, info.evaluation.mean_return
            progress.best_step = info.training_steps
        if progress.best_step is None or (progress.best_success or 0.0, progress.best_return or 0.0) < score:
            problem = f"{run.best_policy}: not the best policy, but that of step {info.training_steps:,}"
    if best_step is None or not problem:
        return []
    return [f"warning: {problem}; the best one was that of step {best_step:,}, and is lost unless a checkpoint has it"]


def check_stop_success(recipe: Recipe, task: str, may_succeed: bool) -> None:
    """Raise `RecipeError` where a recipe waits for success and the task does not report it."""
    if may_succeed:
        return
    if recipe.stop_success is not None:
        raise RecipeError(f"stop_success: {task} does not report success; leave it out")
    for number, stage in enumerate(recipe.stages, start=1):
        if stage.promote is not None and stage.promote.success is not None:
            raise RecipeError(
                f"stage {number} of {len(recipe.stages)}: promote.success: {task} does not report success; "
                "promote by return: promote: {return: 50.0}"
            )
