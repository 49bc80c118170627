"""`rlctl tune TASK`: searches hyperparameters of a task, a few at a time, by comparing trainings.

The usual order: first the learning rate, then rollout and minibatch, then the discount; each step starts from the best
values so far. TPE (Bergstra et al. 2011, https://papers.nips.cc/paper/4443) proposes values, and a trial is stopped if
it is below the median of the others at the same evaluation.
"""

import math
import os
import shlex
from collections.abc import Mapping
from typing import Any

from rlctl import output
from rlctl.environments import named_task
from rlctl.environments.spec import merge
from rlctl.errors import ArtifactError, TaskError, UsageError, explain_missing_package
from rlctl.launching.trainings import MakeTrainings, make_local_trainings
from rlctl.recipe.hyperparameters import ON_POLICY
from rlctl.recipe.recipe import Recipe, fill_parameters
from rlctl.recipe.recipe_files import find_config
from rlctl.recipe.sources import resolve_with_stages
from rlctl.runs.directory import RunLock, create_group_folder
from rlctl.runs.train_request import TrainRequest
from rlctl.training.start import find_start, preserve_process_state
from rlctl.tuning.space import Dimension, list_usual_steps, list_values, nest, parse_search
from rlctl.tuning.tune_request import TuneRequest
from rlctl.tuning.tuning import Trial, Tuning, find, load

_FEWEST_EVALUATIONS = 6
_EVALUATIONS = 10
_CHANGE_THE_RETURN = ("task", "reward_weights", "events", "randomize")


def tune(
    request: TuneRequest, *, jobs: int | None = None, make_trainings: MakeTrainings = make_local_trainings
) -> Tuning:
    """Search hyperparameters, or resume a tuning and its interrupted trials; return the tuning.

    Raises `UsageError` without optuna or for an invalid search, `RecipeError` for values that a recipe cannot have,
    `TaskError` if the unchanged recipe cannot be trained, `Interrupted` after a signal.
    """
    if (request.task is None) == (request.resume is None):
        raise UsageError("TASK and --resume exclude each other: give a task to tune, or --resume FOLDER")
    try:
        import optuna  # noqa: F401
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("rlctl tune", error.name, "tune")) from None
    # Read twice: first to refuse a folder that is no tuning before locking it, then again under the lock.
    if request.resume is None:
        tuning = _begin(request, request.task or "")
    else:
        tuning = find(request.resume, request.root)
        _check_resumed(tuning)
    with RunLock(tuning.path, "tuning"):
        return _search(load(tuning.path), jobs, make_trainings)


def _begin(request: TuneRequest, task: str) -> Tuning:
    recipe = find_start(TrainRequest(task, config=request.config, settings=request.settings)).recipe
    if request.storage is not None:
        _check_storage(request.storage)
    steps = [parse_search(request.search)] if request.search else list_usual_steps(recipe)
    for dimension in (dimension for step in steps for dimension in step):
        _check(dimension, task, request)
    same_episodes = {"eval": {"seed": recipe.seed if recipe.eval.seed is None else recipe.eval.seed}}
    tuning = Tuning(
        path=create_group_folder(task, "tune", request.root),
        task=task,
        config=None if request.config is None else find_config(request.config).absolute(),
        settings=merge(same_episodes, _evaluate_often_enough(recipe, request.settings)),
        metric=request.metric,
        trials_per_step=request.trials,
        seed=recipe.seed,
        steps=steps,
        storage=request.storage,
    )
    tuning.save()
    return tuning


def _check_resumed(tuning: Tuning) -> None:
    """Raise `ArtifactError` for a tuning, perhaps somebody else's, that would run a program or create a database."""
    named_task.check_source(tuning.task, named_task.TUNING)
    if tuning.storage is None:
        return
    from sqlalchemy.engine import make_url  # with Optuna
    from sqlalchemy.exc import ArgumentError

    try:
        url = make_url(tuning.storage)
    except ArgumentError:
        raise ArtifactError(f"{tuning.path}: its storage {tuning.storage!r} is not the URL of a database") from None
    if url.get_backend_name() == "sqlite" and not os.path.isfile(url.database or ""):
        what = f"{url.database}, the database of its trials,"
        raise ArtifactError(f"{tuning.path}: {what} does not exist in the current folder")


def _check_storage(url: str) -> None:
    import optuna

    try:
        optuna.storages.get_storage(url)
    except Exception as error:  # any of SQLAlchemy's and its drivers'
        raise UsageError(f"--storage {url}: cannot be opened: {str(error).splitlines()[0]}") from None


def _check(dimension: Dimension, task: str, request: TuneRequest) -> None:
    key, first = dimension.key, dimension.key.partition(".")[0]
    if key in ("seed", "total_timesteps", "stop_success") or first in ("eval", "checkpoint"):
        raise UsageError(f"--search {key}: not a hyperparameter: it changes the measurement, not the policy")
    if first in _CHANGE_THE_RETURN and request.metric == "return":
        raise UsageError(f"--search {key}: it changes the reward, so returns are not comparable; use --metric success")
    for value in dimension.ends():
        resolve_with_stages(task, request.config, merge(request.settings, nest({key: value})))


def _evaluate_often_enough(recipe: Recipe, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings, with more frequent evaluations if there were too few to compare trials."""
    every = recipe.eval.every_steps or recipe.total_timesteps
    if recipe.total_timesteps // every >= _FEWEST_EVALUATIONS:
        return dict(settings)
    return merge(settings, {"eval": {"every_steps": max(1, recipe.total_timesteps // _EVALUATIONS)}})


def _search(tuning: Tuning, jobs: int | None, make_trainings: MakeTrainings) -> Tuning:
    # It imports optuna, which is optional.
    from rlctl.tuning.search import StepSearch, train

    resume_command = f"rlctl tune --resume {shlex.quote(str(tuning.path))}"
    with preserve_process_state():
        recipe = tuning.resolve_recipe()
    trainings = make_trainings(tuning.path, tuning.task, tuning.trials_per_step, jobs)
    output.print_notes([_describe(tuning, recipe, trainings.describe()), *_warn_of_long_rollouts(recipe)])
    if not tuning.trials:
        tuning.trials.append(Trial(0, 0, {}))
    first = tuning.trials[0]
    if first.state in ("begun", "failed"):
        trainings = make_trainings(tuning.path, tuning.task, 1, 1)
        trainings.run([lambda: train(tuning, first, trainings)], resume_command)
        tuning.save()
        if first.score is None:
            raise TaskError(f"{tuning.path}: the unchanged recipe failed: {first.problem}\nto retry: {resume_command}")
    for number in range(1, len(tuning.steps) + 1):
        trainings = make_trainings(tuning.path, tuning.task, tuning.trials_per_step, jobs)
        step = StepSearch(tuning, number, list_values(recipe), trainings)
        trainings.run([step.run_next] * step.count_waiting(), resume_command)
    return tuning


def _warn_of_long_rollouts(recipe: Recipe) -> list[str]:
    rollout = int(fill_parameters(recipe)["n_steps"]) * recipe.n_envs
    if recipe.algo not in ON_POLICY or rollout * _FEWEST_EVALUATIONS <= recipe.total_timesteps:
        return []
    evaluations = output.format_count(math.ceil(recipe.total_timesteps / rollout), "evaluation")
    rollouts = f"rollouts of {rollout:,} steps (n_steps x n_envs)"
    return [f"warning: a trial has only {evaluations}: they happen between {rollouts}; make trials longer with -n"]


def _describe(tuning: Tuning, recipe: Recipe, where: str) -> str:
    names = "; then ".join(" and ".join(dimension.name for dimension in step) for step in tuning.steps)
    trials = output.format_count(tuning.trials_per_step, "trial")
    if len(tuning.steps) > 1:
        trials += f" each, {tuning.trials_per_step * len(tuning.steps):,} trainings in all,"
    size = f"at most {trials} of {recipe.total_timesteps:,} steps, {where}"
    return f"{tuning.path}: {names}; {size}; -n changes their length, --trials their number"
