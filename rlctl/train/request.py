"""`rlctl train`: from what was asked for to a finished run."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import Interrupted, RecipeError, TaskError, UsageError
from rlctl.named_task import RUN
from rlctl.rollout.workers import Workers
from rlctl.run import directory
from rlctl.run.directory import RunDirectory, RunLock
from rlctl.run.env_info import EnvInfo
from rlctl.run.recipe import Recipe, resolve, validate
from rlctl.train import status
from rlctl.train.display import Display, make_display
from rlctl.train.precheck import Precheck

if TYPE_CHECKING:
    from rlctl.train.loop import TrainingLoop
    from rlctl.train.progress import Progress

_EVAL_ENVS = 32
_FOR_RESUME = ("total_timesteps", "stop_success")


@dataclasses.dataclass(frozen=True)
class TrainRequest:
    """What the command line asks for."""

    task: str | None
    resume: str | None = None
    config: Path | None = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    device: str = "cpu"
    record: int = 0
    env_timeout_s: float = 60.0
    root: Path = directory.ROOT
    check: bool = False
    """Whether to check the environment first, and to refuse one that has errors."""


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """How a training ended."""

    run: RunDirectory
    task: str
    steps: int
    seconds: float
    best_step: int | None
    best_success: float | None
    best_return: float | None
    eval_episodes: int
    recordings: list[Path]
    note: str = ""
    stage: int = 0
    """Stage of the curriculum at the end, from 1; 0 where there is none."""
    stages: int = 0


@dataclasses.dataclass(frozen=True)
class _Start:
    """Where a training starts: at nothing, or at a checkpoint."""

    task: str
    recipe: Recipe
    run: RunDirectory | None = None
    lock: RunLock | None = None
    checkpoint: Path | None = None
    state: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def stage(self) -> int:
        """Stage of the curriculum, from 1."""
        return self.state["progress"].get("stage") or 1 if self.state else 1


def run_training(request: TrainRequest) -> TrainResult:
    """Train, or go on with a run; returns when it is done. Raises `Interrupted` after a signal."""
    if (request.task is None) == (request.resume is None):
        raise UsageError("give a task to train, or --resume RUN to go on with a run; one of the two")
    start = _new(request) if request.task is not None else _resumed(request)
    try:
        return _run(request, start)
    finally:
        if start.lock is not None:
            start.lock.release()


def _run(request: TrainRequest, start: _Start) -> TrainResult:
    if start.state and start.state["counters"]["num_timesteps"] >= start.recipe.total_timesteps:
        return _nothing_to_do(start)
    specs = start.recipe.env_specs(start.task, named_by=RUN if start.run else "")
    title = f"{'resume' if start.state else 'train'} {start.task} ({start.recipe.algo})"
    with make_display(title, start.recipe.total_timesteps) as display:
        # The workers build their environments, and the check runs, while this process imports torch.
        workers = _workers(specs[start.stage - 1], start.recipe.n_envs, request, display)
        precheck = Precheck(specs[-1], request.env_timeout_s) if request.check and not start.state else None
        try:
            return _train(request, start, specs, workers, precheck, display)
        finally:
            workers.close()


def _goal(specs: list[EnvSpec], workers: Workers, request: TrainRequest, display: Display) -> EnvInfo:
    """Return what the last stage's environments are, after a look at every stage: now, not after hours of training."""
    if len(specs) == 1:
        return workers.info
    from rlctl.train.curriculum import check_stages

    with _workers(specs[0], 1, request, display) as probe:
        return check_stages(specs, probe)


def _new(request: TrainRequest) -> _Start:
    task = request.task or ""
    constructor: Any = registry.load(task)
    stages = constructor.stages if registry.is_task(constructor) else ()
    return _Start(task, resolve(task, request.config, request.settings, stages))


def _resumed(request: TrainRequest) -> _Start:
    from rlctl.train import checkpoint

    for key in request.settings:
        if key not in _FOR_RESUME:
            raise UsageError(f"--resume goes on with the run's own recipe: {key} cannot be changed, only -n")
    if request.config is not None:
        raise UsageError("--resume goes on with the run's own recipe: leave out --config")
    run = directory.find_run(request.resume, request.root)
    recipe = run.recipe()
    recipe = validate({**recipe.model_dump(by_alias=True), **request.settings}, "recipe")
    lock = run.lock()  # before looking: a process that is training removes old checkpoints
    try:
        run.remove_leftovers()
        folder, state = checkpoint.newest(run)
    except BaseException:
        lock.release()
        raise
    return _Start(run.status()["task"], recipe, run, lock, folder, state)


def _nothing_to_do(start: _Start) -> TrainResult:
    assert start.run is not None
    progress = start.state["progress"]
    return TrainResult(
        start.run,
        start.task,
        start.state["counters"]["num_timesteps"],
        progress["seconds"],
        progress["best_step"],
        progress["best_success"],
        progress["best_return"],
        start.recipe.eval.episodes,
        [],
        note="this run is finished already: nothing to do; -n makes it longer",
        stage=progress.get("stage", 0),
        stages=len(start.recipe.stages),
    )


def _workers(spec: EnvSpec, n_envs: int, request: TrainRequest, display: Display) -> Workers:
    return Workers(spec, n_envs, timeout_s=request.env_timeout_s, on_output=display.message)


def _train(
    request: TrainRequest,
    start: _Start,
    specs: list[EnvSpec],
    workers: Workers,
    precheck: Precheck | None,
    display: Display,
) -> TrainResult:
    from rlctl.run.torch_policy import pin_threads
    from rlctl.train import checkpoint
    from rlctl.train.algorithms import build_model
    from rlctl.train.curriculum import Curriculum
    from rlctl.train.loop import TrainingLoop
    from rlctl.train.progress import Progress, cut_back
    from rlctl.train.tensorboard import make_logger, writer_errors
    from rlctl.train.vec_env import WorkerVecEnv

    pin_threads()
    recipe = start.recipe
    goal = _goal(specs, workers, request, display)
    if not _may_succeed(workers):
        _refuse_success(start.task, recipe)
    progress = Progress(next_eval=recipe.eval.every_steps or recipe.total_timesteps)
    if start.state:
        progress = Progress(**start.state["progress"])
    curriculum = Curriculum(recipe.stages, specs, goal, progress)
    env = WorkerVecEnv(workers, recipe.seed, list(progress.episodes_started) or None)
    model = build_model(recipe, env, request.device)
    if start.checkpoint is not None:
        checkpoint.restore(model, start.checkpoint, dict(start.state))
    if precheck is not None:
        precheck.refuse_errors(display)
    run = start.run or directory.create(start.task, recipe.seed, request.root)
    lock = start.lock or run.lock()
    if start.state:
        cut_back(run, progress)
    resumed_at = start.state["counters"]["num_timesteps"] if start.state else None
    status.write_start(run, start.task, recipe, request.device, resumed_at)
    model.set_logger(make_logger(run.tensorboard, display.message))

    # They build their environments beside the first updates, which leave a core idle.
    eval_workers = _workers(specs[-1], min(recipe.eval.episodes, _EVAL_ENVS), request, display)
    loop = TrainingLoop(run, recipe, env, eval_workers, progress, display, curriculum)
    if recipe.stages:
        display.stage(curriculum.title)
    try:
        with _signals(loop, display), writer_errors(display.message):
            _learn(model, loop, recipe)
        recordings = _record(loop, request.record)
    except BaseException as error:
        with contextlib.suppress(OSError):  # a full disk must not hide the error itself
            status.write_failure(run, error)
        raise
    finally:
        eval_workers.close()
        lock.release()
    status.write_end(run, model.num_timesteps, progress)
    return _result(run, start, model.num_timesteps, progress, recordings)


def _may_succeed(workers: Workers) -> bool:
    # Of a plain environment it is not known before an episode has ended.
    return workers.info.has_success or not workers.info.reward_weights


def _refuse_success(task: str, recipe: Recipe) -> None:
    if recipe.stop_success is not None:
        raise RecipeError(f"stop_success: {task} does not report success; leave it out")
    for number, stage in enumerate(recipe.stages, start=1):
        if stage.promote is not None and stage.promote.success is not None:
            raise RecipeError(
                f"stage {number} of {len(recipe.stages)}: promote.success: {task} does not report success; "
                "promote by return: promote: {return: 50.0}"
            )


def _learn(model: Any, loop: TrainingLoop, recipe: Recipe) -> None:
    from rlctl.train.loop import TrainingStopped

    try:
        model.learn(
            max(recipe.total_timesteps - model.num_timesteps, 1),
            callback=loop,
            reset_num_timesteps=False,
        )
    except TrainingStopped:
        return
    except TaskError:
        loop.save_after_fault()
        raise
    except ValueError:
        loop.check_finite()  # SB3 notices NaN weights by a distribution's complaint
        raise
    loop.finish()


@contextlib.contextmanager
def _signals(loop: TrainingLoop, display: Display) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the training at the next boundary; a second one ends it now."""

    def handle(number: int, frame: Any) -> None:
        if loop.stop_signal is not None:
            raise Interrupted("interrupted again: stopped at once, the last checkpoint stands", number)
        loop.stop_signal = number
        display.message("stopping after this update, with a checkpoint; once more to stop now")

    # Set even where a shell has made SIGINT ignored, as for a command in the background.
    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _record(loop: TrainingLoop, count: int) -> list[Path]:
    if not count:
        return []
    from rlctl.replay.recording import record_episode

    recordings = []
    for path, episode in loop.episodes.latest(count):
        recording = path.with_suffix(".rrd")
        record_episode(episode, recording, title=f"{loop.run_directory.path.name} / episode {path.stem}")
        recordings.append(recording)
    return recordings


def _result(run: RunDirectory, start: _Start, steps: int, progress: Progress, recordings: list[Path]) -> TrainResult:
    return TrainResult(
        run,
        start.task,
        steps,
        progress.seconds,
        progress.best_step,
        progress.best_success,
        progress.best_return,
        start.recipe.eval.episodes,
        recordings,
        stage=progress.stage,
        stages=len(start.recipe.stages),
    )
