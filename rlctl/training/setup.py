"""Sets up a training: workers, the check before it, the lock and the run folder."""

from __future__ import annotations

import contextlib
import functools
import shlex
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.check import CheckReport, check
from rlctl.checking.rule import Severity
from rlctl.checking.rule_index import find_rules
from rlctl.environments import registry
from rlctl.environments.info import EnvInfo
from rlctl.environments.registrations import describe_registrations
from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, RecipeError, TaskError
from rlctl.output import format_count
from rlctl.play.shared_world import explain_processes
from rlctl.play.workers import Workers, count_envs
from rlctl.printed_lines import PrintedLines
from rlctl.recipe.hindsight import has_sparse_reward, suggest_hindsight
from rlctl.recipe.recipe import ON_POLICY, Recipe
from rlctl.recipe.stages import FollowingLevel
from rlctl.runs import directory
from rlctl.runs.directory import RunDirectory
from rlctl.training import status
from rlctl.training.callbacks import Callbacks, Observer
from rlctl.training.display import Display
from rlctl.training.progress import Progress
from rlctl.training.start import Start
from rlctl.training.warm_start import load_source

if TYPE_CHECKING:
    from rlctl.training.checkpoints import Checkpoints
    from rlctl.training.learner import Learner
    from rlctl.training.loop import TrainingLoop


_CHECK_BUDGET_S = 2.0  # time for playing episodes [s], without importing and building the environment
_FAILURES = ("RL104", "RL207", "RL208", "RL209", "RL601")
"""Rules of an environment that raises, crashes, hangs or returns NaN, which ends a training with the same exit code."""
_EXPERIMENTS = ("build", "comparisons", "episodes")  # what one child process can do in that time


@contextlib.contextmanager
def set_up(
    start: Start, display: Display, printed: PrintedLines, observers: Sequence[Observer] = ()
) -> Iterator[TrainingLoop]:
    """Open what a training needs; at the end stop its processes, and write an error that ended it to the run."""
    recipe, request = start.recipe, start.request
    specs = [spec.resolve() for spec in start.env_specs]
    display.phase(f"building {format_count(recipe.n_envs, 'environment')}, importing PyTorch")
    with contextlib.ExitStack() as stack:
        stack.callback(printed.report)
        # The workers build their environments, and the check runs, while this process imports torch.
        make_workers = functools.partial(Workers, timeout_s=request.env_timeout_s)
        privileged = None if recipe.privileged is None else recipe.privileged.model_dump()
        teacher = None if start.teacher is None else start.teacher.to_message()
        workers = stack.enter_context(
            make_workers(specs[start.stage - 1], recipe.n_envs, privileged=privileged, teacher=teacher)
        )
        checked = _begin_check(specs[-1], request.env_timeout_s) if request.check and start.run is None else None
        from rlctl.training.evaluator import EvaluationEpisodes, Evaluator
        from rlctl.training.loop import TrainingLoop

        learner = _build_learner(start, specs, workers, make_workers, display)
        stack.callback(learner.rollouts.close)
        if workers.shared_world is not None:
            display.message(explain_processes(workers.shared_world, workers.n_envs))
        if start.run is None:
            _warn_of_opposite_weights(specs, display)
            if registered := describe_registrations(start.task, "train"):
                display.message(f"{start.task} is {registered}")
        rewards: list[NDArray[np.float64]] = []
        if checked is not None:
            display.phase("checking the environment")
            _refuse_errors(report := checked.result(), display)
            rewards = [trajectory.rewards for trajectory in report.records.trajectories]
        if start.run is None:
            _suggest_hindsight(recipe, workers.info, rewards, display)
        run = start.run or directory.create(start.task, recipe.seed, request.root)
        lock = start.lock or stack.enter_context(run.lock())
        if not lock.keeps_out:
            display.message(f"warning: {run.path}: this file system has no locks: let only one process train this run")
        checkpoints = _open_run(run, start, learner, display, observers)
        goal_spec = learner.curriculum.goal_spec
        n_envs = count_envs(goal_spec, recipe.eval.episodes)
        episodes = EvaluationEpisodes(learner, functools.partial(make_workers, goal_spec, n_envs), checkpoints)
        stack.callback(episodes.close)
        evaluator = Evaluator(learner, episodes, checkpoints, display)
        if start.run is not None:
            evaluator.restore()
        printed.log_to(run.printed_file)
        printed.report()
        display.run_folder(run)
        for observer in observers:
            stack.enter_context(observer.follow(run, recipe, display))
        try:
            yield TrainingLoop(learner, evaluator, checkpoints, display)
        except BaseException as error:
            with contextlib.suppress(OSError):  # a full disk must not hide the error itself
                status.write_failure(run, error)
            raise


def _warn_of_opposite_weights(specs: list[EnvSpec], display: Display) -> None:
    own = getattr(registry.load(specs[0].task), "reward_weights", {})
    for name, weight in dict.fromkeys(pair for spec in specs for pair in spec.reward_weights.items()):
        if float(own.get(name, 0.0)) * weight < 0.0:
            task_own = f"the task's own, {float(own[name]):g}"
            display.message(f"warning: reward_weights.{name}: {weight:g} has the opposite sign of {task_own}")


def _suggest_hindsight(recipe: Recipe, env: EnvInfo, rewards: list[NDArray[np.float64]], display: Display) -> None:
    options, is_sparse = suggest_hindsight(recipe, env), has_sparse_reward(rewards)
    if options is None or is_sparse is False:
        return
    what = "goals and a sparse reward" if is_sparse else "goals, perhaps with a sparse reward"
    display.message(f"hint: this environment has {what}; it is learned faster with hindsight: add {options}")


def _build_learner(
    start: Start, specs: list[EnvSpec], workers: Workers, make_workers: Callable[..., Workers], display: Display
) -> Learner:
    import torch

    from rlctl.policy.torch_policy import pin_threads
    from rlctl.training.algorithms import build_on_device
    from rlctl.training.learner import Curriculum, Learner, check_stages
    from rlctl.training.off_policy import OffPolicyRollouts
    from rlctl.training.on_policy import OnPolicyRollouts
    from rlctl.training.rollouts import Rollouts, WorkerVecEnv

    pin_threads()
    recipe, goal = start.recipe, workers.info
    if len(specs) > 1:  # check every stage now, not after hours of training
        privileged = None if recipe.privileged is None else recipe.privileged.model_dump()
        with make_workers(specs[0], 1, privileged=privileged) as probe:
            goal = check_stages(specs, probe)
    # A plain Gymnasium environment shows only at the end of an episode whether it reports success.
    if workers.info.reward_weights and not workers.info.has_success:
        _refuse_success_rates(start)
    if recipe.mixed_ages and not workers.info.reward_weights:
        raise RecipeError(f"mixed_ages: {start.task} is a plain Gymnasium environment, whose time limit is its own")
    if any(isinstance(stage.level, FollowingLevel) for stage in recipe.stages) and not workers.info.reward_weights:
        raise RecipeError(f"level: {start.task} is a plain Gymnasium environment; only tasks have levels")
    # A policy that begins trained is evaluated first: it may be better than all later ones.
    next_eval = 0 if start.is_trained else recipe.eval.every_steps or recipe.total_timesteps
    progress = start.checkpoint.state.progress if start.checkpoint else Progress(next_eval)
    env = WorkerVecEnv(workers, recipe.seed)
    env.mixes_ages = recipe.mixed_ages
    model, line = build_on_device(recipe, env, start.request.device, cuda_available=torch.cuda.is_available())
    if line is not None:
        display.message(line)
    if start.teacher is not None:
        from rlctl.training.distilling.rollouts import DistillingRollouts

        rollouts: Rollouts = DistillingRollouts(model, env, recipe, progress, start.teacher.steps)
    else:
        rollouts = (OnPolicyRollouts if recipe.algo in ON_POLICY else OffPolicyRollouts)(model, env, recipe, progress)
    rollouts.is_trained = start.is_trained
    if start.source is not None and start.checkpoint is None:
        display.message(load_source(start.source, model, goal))
    if start.demos is not None:
        from rlctl.training.demonstrations import clone

        display.phase("cloning demonstrations")
        clone(start, rollouts, goal, display.message)
    curriculum = Curriculum(recipe.stages, specs, goal, progress)
    env.follow_success(curriculum.level_rule)
    return Learner(recipe, rollouts, curriculum, progress)


def _refuse_success_rates(start: Start) -> None:
    recipe, problem = start.recipe, f"{start.task} does not report success"
    if recipe.stop_success is not None:
        raise RecipeError(f"stop_success: {problem}; leave it out")
    for number, stage in enumerate(recipe.stages, start=1):
        if isinstance(stage.level, FollowingLevel):
            raise RecipeError(f"stage {number} of {len(recipe.stages)}: level: {problem}, which it would follow")
        if stage.promote is not None and stage.promote.success is not None:
            raise RecipeError(
                f"stage {number} of {len(recipe.stages)}: promote.success: {problem}; "
                "promote by return: promote: {return: 50.0}"
            )


def _open_run(
    run: RunDirectory, start: Start, learner: Learner, display: Display, observers: Sequence[Observer]
) -> Checkpoints:
    from rlctl.training.checkpoints import Checkpoints
    from rlctl.training.metrics import make_logger

    resumed_at = None if start.run is None else start.step
    learner.model.set_logger(make_logger(run.tensorboard, display.message, resumed_at, start.recipe))
    callbacks = Callbacks(start.callbacks, learner, run.path, display.message, observers)
    checkpoints = Checkpoints(learner, run, callbacks, display.message)
    for note in start.notes:
        display.message(note)
    if start.checkpoint is not None:
        display.message(checkpoints.restore(start.checkpoint, start.inexact))
    for warning in checkpoints.cut_back(start.step) if start.run else ():
        display.message(warning)
    if start.teacher is not None and start.run is None:
        start.teacher.copy_to(run)
    status.write_start(run, start, str(learner.model.device))
    return checkpoints


def _begin_check(spec: EnvSpec, env_timeout_s: float) -> Future[CheckReport]:
    """Check an environment in a child process; a thread of this process waits for it."""
    future: Future[CheckReport] = Future()

    def run() -> None:
        try:
            report = check(
                spec,
                rules=find_rules(_EXPERIMENTS),
                only=_EXPERIMENTS,
                budget_s=_CHECK_BUDGET_S,
                env_timeout_s=env_timeout_s,
                show_progress=False,
            )
            future.set_result(report)
        except BaseException as error:  # `result()` raises it
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()  # the child ends with this process
    return future


def _refuse_errors(report: CheckReport, display: Display) -> None:
    if report.records.built is None:
        return  # the workers build it too, and report the error
    for name in report.verdict.crashed:
        display.message(f"check before training: {name} crashed because of a bug in rlctl; this rule was not checked")
    task, findings = shlex.quote(report.task), report.verdict.findings
    errors = [finding for finding in findings if finding.severity is Severity.ERROR]
    if errors:
        text = "; ".join(f"{finding.rule} {finding.name} ({finding.message})" for finding in errors)
        raise (TaskError if any(finding.rule in _FAILURES for finding in errors) else AnswerIsNo)(
            f"the check before training found {format_count(len(errors), 'error')}: {text}\n"
            f"fix{f' of {errors[0].rule}' * (len(errors) > 1)}: {errors[0].fix}\n"
            f"rlctl check-env {task} shows details; --no-check trains anyway."
        )
    for finding in findings:
        if finding.rule == "RL503":  # evaluations wait for the end of episodes
            steps, fix = max(finding.evidence["steps"].values()), finding.fix.partition(". ")[0]
            option = "; here: --set task.max_episode_steps=1000" if registry.is_gymnasium_id(report.task) else ""
            ends = "an evaluation fails if an episode does not end"
            display.message(f"warning: no episode ended within {steps:,} steps of the check, and {ends}. {fix}{option}")
    if warnings := [finding.rule for finding in findings if finding.severity is Severity.WARNING]:
        display.message(f"check before training: warnings {', '.join(warnings)}; rlctl check-env {task} shows details")
