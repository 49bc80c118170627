"""Start of a training: from step 0, or from the newest undamaged checkpoint of a run."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import inspect
import os
import re
import shlex
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.environments import named_task, registry
from rlctl.environments.named_task import RUN
from rlctl.environments.registry import describe_task_changes
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError, RlctlError, UsageError, explain_missing_package
from rlctl.hub import store
from rlctl.policy import own_modules
from rlctl.recipe.recipe import ALGORITHMS, Recipe, validate
from rlctl.recipe.recipe_files import describe_own_preset
from rlctl.recipe.sources import describe_other_algorithm, describe_rounding, resolve_with_stages
from rlctl.runs import lookup
from rlctl.runs.directory import RunDirectory, RunLock
from rlctl.runs.train_request import TrainRequest
from rlctl.storage import files
from rlctl.training.callbacks import Callback, Sb3Callback, call_callback, is_of_sb3
from rlctl.training.distilling.teacher import Teacher
from rlctl.training.warm_start import find_source

if TYPE_CHECKING:
    from rlctl.training.checkpoint_file import Checkpoint

_WITHOUT_DEMONSTRATIONS = ("dqn", "recurrent_ppo")
_NO_CALLBACK = "neither a rlctl.Callback nor a BaseCallback of Stable-Baselines3"
_DEMONSTRATIONS = (".npz", ".parquet", ".hdf5", ".arrow", ".json")  # suffixes of files
_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?|mps|xpu(:\d+)?")


@dataclasses.dataclass(frozen=True)
class Start(contextlib.AbstractContextManager["Start"]):
    """Start of a training; while entered it holds the lock of a resumed run."""

    request: TrainRequest
    task: str
    recipe: Recipe
    run: RunDirectory | None = None  # the resumed run; None for a new one
    lock: RunLock | None = None
    checkpoint: Checkpoint | None = None
    notes: tuple[str, ...] = ()  # messages for the user, before the first step
    callbacks: Mapping[str, Callback] = dataclasses.field(default_factory=dict)
    source: Mapping[str, Any] | None = None  # the policy of `--from`; see `warm_start.find_source`
    demos: Mapping[str, str] | None = None  # the demonstrations of `--demos`; see `describe_demonstrations`
    teacher: Teacher | None = None  # of a student that `rlctl distill` trains
    inexact: tuple[str, ...] = ()  # reasons, known before the start, why the resume cannot be bit-exact
    began: float = dataclasses.field(default_factory=time.monotonic)

    def __exit__(self, *_: object) -> None:
        if self.lock is not None:
            self.lock.release()

    @property
    def env_specs(self) -> list[EnvSpec]:
        """The environments of the curriculum's stages; a run's file names the task of a resumed one."""
        return self.recipe.env_specs(self.task, named_by="" if self.run is None else RUN)

    @property
    def stage(self) -> int:
        """Stage of the curriculum, from 1."""
        return (self.checkpoint.state.progress.stage or 1) if self.checkpoint else 1

    @property
    def is_trained(self) -> bool:
        """Whether the policy begins trained, by `--from` or `--demos`."""
        return self.source is not None or self.demos is not None

    @property
    def step(self) -> int:
        """Environment steps that are done."""
        return self.checkpoint.state.step if self.checkpoint else 0


def find_start(request: TrainRequest) -> Start:
    """Check a request and return its start; nothing is changed yet."""
    check_arguments(request)
    return _find_resumed(request) if request.task is None else _find_new(request, request.task)


def check_arguments(request: TrainRequest) -> None:
    """Raise `UsageError` for arguments that exclude each other, and for a device that cannot exist."""
    if (request.task is None) == (request.resume is None):
        problem = "TASK and --resume exclude each other" if request.task else "neither TASK nor --resume is given"
        raise UsageError(f"{problem}: give a task to train, or a run to resume")
    if request.demos is not None and request.initial_policy is not None:
        raise UsageError("--demos and --from exclude each other: cloning would replace the policy of --from")
    if request.demos is not None and not os.path.exists(request.demos):
        raise UsageError(f"--demos {request.demos}: no such file or folder")
    if not _DEVICE.fullmatch(request.device):  # checked before slow imports
        raise UsageError(f"--device {request.device!r}: no such device; give cpu, cuda, cuda:1, or auto")
    if request.resume is None:
        return
    given = {"--config": request.config, "--demos": request.demos, "--from": request.initial_policy}
    for option, value in given.items():
        if value is not None:
            raise UsageError(f"{option} and --resume exclude each other: the run has its own recipe and policy")
    for key in request.settings:
        if key != "total_timesteps":
            raise UsageError(f"--resume uses the run's own recipe: {key} cannot be changed; only -n can")


def _find_new(request: TrainRequest, task: str) -> Start:
    with preserve_process_state():
        recipe = own_modules.locate(resolve_with_stages(task, request.config, request.settings))
        callbacks = _load_callbacks(recipe)
    _check_tracker(recipe)
    source = find_source(request.initial_policy, recipe) if request.initial_policy is not None else None
    if request.demos is not None and (algo := recipe.algo) in _WITHOUT_DEMONSTRATIONS:
        others = ", ".join(name for name in ALGORITHMS if name not in _WITHOUT_DEMONSTRATIONS)
        raise RecipeError(f"--demos: {algo} cannot clone demonstrations; these can: {others}")
    if request.demos is not None and recipe.privileged is not None:
        raise RecipeError("--demos: demonstrations do not hold what only the critic sees; add --set privileged=null")
    notes = describe_other_algorithm(task, request.config, request.settings)
    if not notes and request.config is None and (preset := describe_own_preset(task)):
        notes.append(preset)
    if (rounding := describe_rounding(recipe)) is not None:
        notes.append(rounding)
    demos = describe_demonstrations(Path(request.demos)) if request.demos is not None else None
    return Start(request, task, recipe, notes=tuple(notes), callbacks=callbacks, source=source, demos=demos)


def _find_resumed(request: TrainRequest) -> Start:
    from rlctl.training import checkpoint_file

    run = lookup.find_run(request.resume, request.root, to_train=True)
    before = run.recipe()
    lock = run.lock()  # before looking: a process that is training removes old checkpoints
    try:
        recipe = validate({**before.model_dump(by_alias=True), **request.settings}, "recipe")
        _check_tracker(recipe)
        status = run.status()
        task = lookup.locate_task(status["task"], run)
        changes = describe_task_changes(status, task)
        for name in recipe.callbacks:
            changes += describe_task_changes(status.get("callbacks", {}).get(name, {}), name)
        if changes and not request.force:
            raise UsageError(f"{run.path}: {'; '.join(changes)}. The policy may no longer fit; --force resumes anyway")
        run.recover()
        newest, damage = checkpoint_file.read_newest(run)
        if newest is None and status.get("status") == "finished":
            command = shlex.join(["rlctl", "train", task, "--from", str(run.path)])
            raise ArtifactError(f"{run.path}: finished, and its checkpoints were removed; train from it: {command}")
        notes = ["no checkpoint yet: the training starts from step 0"]
        if newest is not None:
            newest = _reopen(newest, before, recipe)
            notes = [f"warning: {problem}; resuming from step {newest.state.step:,}" for problem in damage]
        if store.is_cached(run.path) and (names := own_modules.list_names(recipe)):
            raise UsageError(
                f"{run.path}: its recipe names {names[0]}, and a run that was downloaded imports nothing; "
                f"to train further with it: rlctl train {task} --config {run.recipe_file} --from {run.path}"
            )
        entry = status.get("teacher")
        return Start(
            request,
            task,
            recipe,
            run,
            lock,
            newest,
            notes=tuple(notes),
            callbacks=_load_callbacks(recipe),
            source=status.get("from"),
            demos=status.get("demos"),
            teacher=None if entry is None else Teacher.of_run(run, entry),
            inexact=tuple(changes),
        )
    except BaseException:
        lock.release()
        raise


def _reopen(newest: Checkpoint, before: Recipe, recipe: Recipe) -> Checkpoint:
    """Mark a finished training as not done if the request asks for more steps."""
    if not newest.state.progress.done or recipe.total_timesteps <= max(newest.state.step, before.total_timesteps):
        return newest
    progress = dataclasses.replace(newest.state.progress, done=False, good_in_a_row=0, stop_reason="")
    return dataclasses.replace(newest, state=newest.state.model_copy(update={"progress": progress}))


def _load_callbacks(recipe: Recipe) -> dict[str, Callback]:
    return {name: _load_callback(name, arguments or {}) for name, arguments in recipe.callbacks.items()}


def _load_callback(name: str, arguments: Mapping[str, Any]) -> Callback:
    try:
        if ":" not in name:
            raise RecipeError("give the class too: FILE.py:CLASS or MODULE:CLASS")
        constructor = registry.load(name)
    except RlctlError as error:
        problem = str(error).removeprefix(f"task {name!r}: ")
        raise RecipeError(f"callbacks: {name}: {problem}", details=error.details) from None
    if not _may_be_called(constructor):
        raise RecipeError(f"callbacks: {name}: {_NO_CALLBACK}, or a function of your own file that returns one")
    callback: Any = call_callback(name, lambda: constructor(**arguments))
    if is_of_sb3(type(callback)):
        return Sb3Callback(callback)
    if isinstance(callback, Callback):
        return callback
    raise RecipeError(f"callbacks: {name}: {_NO_CALLBACK}")


def _may_be_called(constructor: Any) -> bool:
    # A recipe may come from somebody else: it must not call `os:system`.
    if inspect.isclass(constructor):
        return issubclass(constructor, Callback) or is_of_sb3(constructor)
    return inspect.isfunction(constructor) and named_task.is_own_file(Path(inspect.getfile(constructor)))


def describe_demonstrations(path: Path) -> dict[str, str]:
    """Return the absolute path of demonstrations and a hash of their files, without videos."""
    paths = [path] if path.is_file() else sorted(path.rglob("*"))
    parts = [files.digest(file.read_bytes()) for file in paths if file.suffix in _DEMONSTRATIONS]
    return {"path": str(path.absolute()), "sha256": files.digest("".join(parts).encode())}


@contextlib.contextmanager
def preserve_process_state() -> Iterator[None]:
    """Restore global state that importing a user's module may change; the training sets signal handlers later."""
    try:
        with contextlib.chdir("."), np.errstate():
            yield
    finally:
        if (torch := sys.modules.get("torch")) is not None:
            torch.set_default_dtype(torch.float32)
            torch.set_default_device(None)
            torch.set_grad_enabled(True)


def _check_tracker(recipe: Recipe) -> None:
    if recipe.track is not None and importlib.util.find_spec(recipe.track) is None:
        raise UsageError(explain_missing_package(f"--track {recipe.track}", recipe.track, recipe.track))
