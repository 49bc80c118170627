"""`rlctl train`: from a request to a finished run."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import TaskError, UsageError
from rlctl.named_task import RUN
from rlctl.rollout.workers import Workers, available_cores
from rlctl.run import directory
from rlctl.run.directory import RunDirectory, RunLock
from rlctl.run.env_info import EnvInfo
from rlctl.run.recipe_sources import describe_rounding, resolve
from rlctl.train import status
from rlctl.train.display import Display, make_display
from rlctl.train.precheck import Precheck
from rlctl.train.process_state import preserve_process_state
from rlctl.train.resume import Start, check_stop_success, load_start, prepare
from rlctl.train.signals import StopSignals
from rlctl.train.warm_start import find_source, load_source

if TYPE_CHECKING:
    from rlctl.train.checkpoint import Checkpoint, Checkpoints
    from rlctl.train.loop import Learner, TrainingLoop
    from rlctl.train.progress import Progress
    from rlctl.train.saving import Saver

_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?|mps|xpu(:\d+)?")


@dataclasses.dataclass(frozen=True)
class TrainRequest:
    """The arguments of `rlctl train`."""

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
    force: bool = False
    """Whether to go on with a run even if its task has changed."""
    initial_policy: str | None = None
    """A run, a policy file, or the name of a task that ships a policy: what the training begins with."""


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
    recordings: list[Path]
    note: str = ""
    stage: int = 0
    """Stage of the curriculum at the end, from 1; 0 where there is none."""
    stages: int = 0


def run_training(request: TrainRequest) -> TrainResult:
    """Train, or go on with a run; returns when it is done. Raises `Interrupted` after a signal."""
    if (request.task is None) == (request.resume is None):
        raise UsageError("give a task to train, or --resume RUN to go on with a run; one of the two")
    if not _DEVICE.fullmatch(request.device):  # now, and not after half a minute of imports
        raise UsageError(f"--device {request.device!r}: no such device; give cpu, cuda, cuda:1, or auto")
    with StopSignals() as signals:
        start = _new(request) if request.task is not None else _load_start(request)
        try:
            return _run(request, start, signals)
        finally:
            if start.lock is not None:
                start.lock.release()


def _new(request: TrainRequest) -> Start:
    task = request.task or ""
    with preserve_process_state():
        constructor: Any = registry.load(task)
    stages = constructor.stages if registry.is_task(constructor) else ()
    recipe = resolve(task, request.config, request.settings, stages)
    note = describe_rounding(recipe)
    source = find_source(request.initial_policy, recipe) if request.initial_policy is not None else None
    return Start(task, recipe, notes=(note,) if note else (), source=source)


def _load_start(request: TrainRequest) -> Start:
    if request.config is not None:
        raise UsageError("--resume goes on with the run's own recipe: leave out --config")
    if request.initial_policy is not None:
        raise UsageError("--from begins a new run, and --resume goes on with one: give one of the two")
    return load_start(request.resume, request.settings, request.root, force=request.force)


def _run(request: TrainRequest, start: Start, signals: StopSignals) -> TrainResult:
    if start.checkpoint is not None and start.checkpoint.progress.done:
        return _report_finished(start, start.checkpoint)
    specs = start.recipe.env_specs(start.task, named_by=RUN if start.run else "")
    title = f"{'train' if start.run is None else 'resume'} {start.task} ({start.recipe.algo})"
    with make_display(title, start.recipe.total_timesteps) as display:
        if start.run is None:
            for note in start.notes:
                display.message(note)
        display.phase(f"building {start.recipe.n_envs} environments, importing PyTorch")
        # The workers build their environments, and the check runs, while this process imports torch.
        workers = _workers(specs[start.stage - 1], start.recipe.n_envs, request, display)
        precheck = Precheck(specs[-1], request.env_timeout_s) if request.check and start.run is None else None
        try:
            return _train(request, start, specs, workers, precheck, display, signals)
        finally:
            workers.close()


def _goal(specs: list[EnvSpec], workers: Workers, request: TrainRequest, display: Display) -> EnvInfo:
    """Return what the last stage's environments are, after a look at every stage: now, not after hours of training."""
    if len(specs) == 1:
        return workers.info
    from rlctl.train.curriculum import check_stages

    with _workers(specs[0], 1, request, display) as probe:
        return check_stages(specs, probe)


def _report_finished(start: Start, checkpoint: Checkpoint) -> TrainResult:
    assert start.run is not None  # the checkpoint is in it
    if start.run.status().get("status") == "running":  # killed after all was done
        status.write_end(start.run, checkpoint.state.step, checkpoint.progress)
    _report_failed_evaluations(start.run, checkpoint.progress)
    note = "this run is finished already: nothing to do; -n makes it longer"
    return _result(start.run, start, checkpoint.state.step, checkpoint.progress, [], note)


def _workers(spec: EnvSpec, n_envs: int, request: TrainRequest, display: Display) -> Workers:
    return Workers(spec, n_envs, timeout_s=request.env_timeout_s, on_output=display.message)


def _train(
    request: TrainRequest,
    start: Start,
    specs: list[EnvSpec],
    workers: Workers,
    precheck: Precheck | None,
    display: Display,
    signals: StopSignals,
) -> TrainResult:
    from rlctl.run.torch_policy import pin_threads
    from rlctl.train.evaluation import Evaluator
    from rlctl.train.loop import TrainingLoop

    pin_threads()
    recipe = start.recipe
    learner = _learner(request, start, specs, workers, display)
    if precheck is not None:
        display.phase("checking the environment")
        precheck.refuse_errors(display)
    run = start.run or directory.create(start.task, recipe.seed, request.root)
    with start.lock or run.lock() as lock:
        if not lock.keeps_out:
            display.message(f"warning: {run.path}: no locks on this file system: let no second process write this run")
        saver = _saver(request, start, run, lock, learner, display)
        evaluator = Evaluator(
            recipe, lambda: _workers(specs[-1], min(recipe.eval.episodes, available_cores()), request, display)
        )
        loop = TrainingLoop(run, recipe, learner, evaluator, saver, display, start.checkpoint)
        display.run_folder(run.path, run.metrics_file, run.evals_file)
        try:
            recordings = _learn_to_the_end(loop, request, signals, display)
        except BaseException as error:
            with contextlib.suppress(OSError):  # a full disk must not hide the error itself
                status.write_failure(run, error)
            raise
        finally:
            evaluator.close()
    _report_failed_evaluations(run, learner.progress)
    return _result(run, start, learner.model.num_timesteps, learner.progress, recordings)


def _learner(request: TrainRequest, start: Start, specs: list[EnvSpec], workers: Workers, display: Display) -> Learner:
    from rlctl.train.algorithms import build_model
    from rlctl.train.curriculum import Curriculum
    from rlctl.train.loop import Learner
    from rlctl.train.progress import Progress
    from rlctl.train.vec_env import WorkerVecEnv

    recipe = start.recipe
    goal = _goal(specs, workers, request, display)
    check_stop_success(recipe, start.task, _may_succeed(workers))
    # What a training begins with is evaluated: it may be better than all that follows.
    progress = Progress(next_eval=0 if start.source else recipe.eval.every_steps or recipe.total_timesteps)
    if start.checkpoint is not None:
        progress = start.checkpoint.progress
    env = WorkerVecEnv(workers, recipe.seed)
    model = build_model(recipe, env, request.device)
    if start.source is not None:
        vars(model)["policy_plays_warmup"] = True
        if start.checkpoint is None:
            display.message(load_source(start.source, model, goal))
    return Learner(model, env, Curriculum(recipe.stages, specs, goal, progress), progress)


def _saver(
    request: TrainRequest, start: Start, run: RunDirectory, lock: RunLock, learner: Learner, display: Display
) -> Saver:
    """Restore the checkpoint, if there is one, and return what writes from now on."""
    from rlctl.train.checkpoint import Checkpoints
    from rlctl.train.saving import Saver
    from rlctl.train.tensorboard import make_logger

    resumed_at = None if start.run is None else start.checkpoint.state.step if start.checkpoint else 0
    learner.model.set_logger(make_logger(run.tensorboard, display.message, resumed_at or 0))
    checkpoints = Checkpoints(run, learner.model, learner.env, start.recipe.checkpoint.keep)
    if start.run is not None:
        _restore_run(start, run, checkpoints, learner, display)

    def write_start() -> None:
        lock.renew()
        status.write_start(run, start.task, start.recipe, request.device, resumed_at, start.source)

    write_start()
    saver = Saver(run, checkpoints, display.message, write_start)
    saver.saved_step = start.checkpoint.state.step if start.checkpoint is not None else None
    return saver


def _learn_to_the_end(loop: TrainingLoop, request: TrainRequest, signals: StopSignals, display: Display) -> list[Path]:
    """Train, write that it is done, and return the requested recordings."""
    from rlctl.train.space_monitor import summarize
    from rlctl.train.tensorboard import silence_writer_thread

    if loop.recipe.stages:
        display.stage(loop.curriculum.title)
    signals.begin(loop)
    display.phase("first steps")
    with silence_writer_thread():
        _learn(loop)
    signals.end()
    steps, progress = loop.model.num_timesteps, loop.progress
    if warning := summarize(progress):
        display.message(warning)
    saver, run = loop.saver, loop.run_directory
    saver.retry(lambda: saver.attempt("run.json", lambda: status.write_end(run, steps, progress)))
    return _record(loop, request.record)


def _may_succeed(workers: Workers) -> bool:
    # Of a plain environment it is not known before an episode has ended.
    return workers.info.has_success or not workers.info.reward_weights


def _restore_run(start: Start, run: RunDirectory, checkpoints: Checkpoints, learner: Learner, display: Display) -> None:
    """Restore model, environments and run folder from the checkpoint, and show how exact that is."""
    from rlctl.run.policy import read_policy
    from rlctl.train.checkpoint import find_differences

    for note in start.notes:
        display.message(note)
    if start.checkpoint is not None:
        folder, state = start.checkpoint.folder, start.checkpoint.state
        info, _ = read_policy(folder / "policy.safetensors")
        info.check_fits(learner.curriculum.goal, folder / "policy.safetensors")
        mismatch = checkpoints.restore(start.checkpoint)
        inexact = [*start.inexact, *find_differences(state.computed_with, checkpoints.computed_with())]
        inexact += [mismatch] if mismatch else []
        exactness = f"not bit-exact: {'; '.join(inexact)}" if inexact else "as if it had never stopped"
        display.message(f"going on at step {state.step:,}, {exactness}")
    for note in prepare(run, start.checkpoint, learner.progress):
        display.message(note)


def _learn(loop: TrainingLoop) -> None:
    from rlctl.train.finite import check_finite
    from rlctl.train.loop import TrainingStopped

    missing = loop.recipe.total_timesteps - loop.model.num_timesteps
    try:
        if missing > 0:
            loop.model.learn(missing, callback=loop, reset_num_timesteps=False)
        loop.finish()
    except TrainingStopped:
        return
    except TaskError as error:
        raise loop.explain_fault(error) from None
    except ValueError:
        check_finite(loop.model, loop.run_directory.path)  # SB3 notices NaN weights by a distribution's complaint
        raise


def _report_failed_evaluations(run: RunDirectory, progress: Progress) -> None:
    if progress.failed_evaluations:
        raise TaskError(
            f"{run.path}: the training is done, but {progress.failed_evaluations} of its evaluations failed, "
            f"the first {progress.first_failure}"
        )


def _record(loop: TrainingLoop, count: int) -> list[Path]:
    if not count:
        return []
    from rlctl.replay.reproduce import record_episode

    recordings = []
    for path, episode in loop.episodes.latest(count):
        recording = path.with_suffix(".rrd")
        title = f"{loop.run_directory.path.name} / episode {path.stem}"
        record_episode(episode, recording, title=title, several=count > 1)
        recordings.append(recording)
    return recordings


def _result(
    run: RunDirectory, start: Start, steps: int, progress: Progress, recordings: list[Path], note: str = ""
) -> TrainResult:
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
        recordings,
        note,
        stage=progress.stage,
        stages=len(start.recipe.stages),
    )
