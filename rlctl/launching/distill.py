"""`rlctl distill`: from a request to a student's run, and its comparison with the teacher."""

import dataclasses
import functools
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from rlctl import output
from rlctl.environments.spec import EnvSpec, merge
from rlctl.errors import RecipeError
from rlctl.evaluation.episode_statistics import mean_return, success_interval, success_rate
from rlctl.launching import train as training
from rlctl.launching.distill_request import DistillRequest
from rlctl.play.collect import Episode, play_episodes
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.play.workers import Workers, count_envs
from rlctl.policy.actor import Exploration
from rlctl.policy.file import PolicyFile
from rlctl.recipe.recipe import ON_POLICY, Recipe
from rlctl.recipe.sources import resolve_with_stages
from rlctl.runs import lookup
from rlctl.runs.train_request import TrainRequest
from rlctl.training.distilling.teacher import Teacher
from rlctl.training.start import Start, find_start

EPISODES = 100
"""Unseen episodes in which student and teacher are compared."""
_SHARE_OF_STEPS = 4  # a student takes a quarter of the steps of a training
_EPISODE_SEED = 0  # of `rlctl eval` too, whose result is therefore the same
_BY_CAMERA = {
    "n_envs": 32,
    "total_timesteps": 40_960,
    "eval": {"every_steps": 20_000},
    "algo_kwargs": {"n_steps": 32, "batch_size": 128, "n_epochs": 16},
    "policy_kwargs": {"net_arch": [256, 256]},
}
"""Settings of a student that sees pictures, which take a hundred times the time and memory of numbers: few steps, from
each of which it learns often."""


@dataclasses.dataclass(frozen=True)
class PlayedScore:
    """The score of student or teacher in the unseen episodes."""

    success: float | None
    interval: tuple[float, float] | None
    mean_return: float

    def __str__(self) -> str:
        if self.success is None or self.interval is None:
            return f"return {self.mean_return:.2f}"
        low, high = self.interval
        return f"success {self.success:.1%} (95 % interval {low:.1%} to {high:.1%}), return {self.mean_return:.2f}"


@dataclasses.dataclass(frozen=True)
class DistillResult:
    """A trained student, and how it compares with its teacher in the same worlds."""

    training: training.TrainResult
    student: PlayedScore
    teacher: PlayedScore


def distill(request: DistillRequest) -> DistillResult:
    """Train a student and compare it with its teacher; errors as of a training."""
    found = lookup.find_policy(request.teacher, request.checkpoint)
    output.print_notes(found.notes)
    spec = found.locate(Teacher.read(found.file, 1).info.derive_spec())
    spec.constructor()  # the policy file may come from somebody else: it may name environments only
    settings = make_settings(request, spec)
    recipe = resolve_with_stages(spec.task, None, settings)
    if recipe.algo not in ON_POLICY:
        raise RecipeError(f"distill: a student learns with {', '.join(sorted(ON_POLICY))}, not with {recipe.algo}")
    teacher = Teacher.read(found.file, recipe.total_timesteps)
    settings = {**settings, "total_timesteps": teacher.steps + request.then_ppo}
    train_request = TrainRequest(
        task=spec.task,
        settings=settings,
        device=request.device,
        check=request.check,
        env_timeout_s=request.env_timeout_s,
        root=request.root,
    )
    result = training.run_training(train_request, functools.partial(_find_start, teacher))
    return DistillResult(result, *compare(result, teacher, request))


def _find_start(teacher: Teacher, request: TrainRequest) -> Start:
    return dataclasses.replace(find_start(request), teacher=teacher)


def make_settings(request: DistillRequest, teacher: EnvSpec) -> dict[str, Any]:
    """Return the student's settings: the teacher's environment, what the student observes, and the user's own."""
    environment: dict[str, Any] = {
        "task": dict(teacher.parameters),
        "reward_weights": dict(teacher.reward_weights),
        "randomize": teacher.randomize,
        "events": {name: dict(values) for name, values in teacher.events.items()},
        "stages": [],
    }
    if teacher.sim:
        environment["sim"] = str(teacher.sim)
    if request.observe is None:
        same = teacher.frame_stack, teacher.time_feature, list(teacher.observe), dict(teacher.observation_history)
        names = "frame_stack", "time_feature", "observe", "observation_history"
        environment |= dict(zip(names, same, strict=True))
    else:
        environment["observe"] = [name.strip() for name in request.observe.split(",") if name.strip()]
    packaged = resolve_with_stages(teacher.task).algo
    if packaged not in ON_POLICY:
        # Replay needs fewer environments and steps than a student that learns from its rollouts.
        defaults = Recipe.model_fields
        environment |= {"algo": "ppo", "n_envs": defaults["n_envs"].default}
        environment["total_timesteps"] = defaults["total_timesteps"].default // _SHARE_OF_STEPS
    if _sees_by_camera(teacher, merge(environment, request.settings)):
        environment = merge(environment, {"algo": "ppo", **_BY_CAMERA})
    settings = merge(environment, request.settings)
    settings.setdefault("total_timesteps", _count_steps(teacher.task, settings))
    return settings


def _sees_by_camera(spec: EnvSpec, settings: Mapping[str, Any]) -> bool:
    cameras = getattr(spec.constructor(), "cameras", {})
    return any(name in cameras for name in settings.get("observe", ()))


def _count_steps(task: str, settings: Mapping[str, Any]) -> int:
    return max(1, resolve_with_stages(task, None, settings).total_timesteps // _SHARE_OF_STEPS)


def compare(result: training.TrainResult, teacher: Teacher, request: DistillRequest) -> tuple[PlayedScore, PlayedScore]:
    """Return the scores of the student's best policy and of the teacher, in the student's environment.

    The teacher observes as when it labelled the student's steps.
    """
    student = PolicyFile.read(result.run.best_policy)
    spec = dataclasses.replace(student.info.spec, task=lookup.locate_task(student.info.spec.task, result.run))
    n_envs = count_envs(spec, EPISODES)
    seeds = episode_seeds(_EPISODE_SEED, Stream.EVAL, EPISODES)
    with Workers(spec, n_envs, timeout_s=request.env_timeout_s, teacher=teacher.to_message()) as workers:
        workers.set_policy(student)
        with output.show_progress("comparing with the teacher", 2 * EPISODES, "episodes") as show:
            own = play_episodes(workers, seeds, Exploration(), watch=show)
            taught = play_episodes(workers, seeds, Exploration(), taught=True, watch=lambda n: show(EPISODES + n))
    return _measure(own), _measure(taught)


def _measure(episodes: Sequence[Episode]) -> PlayedScore:
    results = [episode.result for episode in episodes]
    return PlayedScore(success_rate(results), success_interval(results), mean_return(results))


def show(result: DistillResult, json: str | None) -> None:
    """Print how student and teacher did, and what to type next; for `--json -` JSON instead."""
    trained = result.training
    scores = {"student": result.student, "teacher": result.teacher}
    content = {
        "run": str(trained.run.path),
        "task": trained.task,
        "steps": trained.steps,
        "episodes": EPISODES,
        **{name: dataclasses.asdict(score) for name, score in scores.items()},
    }
    if output.present(content, json):
        return
    lines = [f"distilled {trained.task}: {trained.steps:,} steps; in {EPISODES} unseen episodes"]
    lines += [f"  {name}: {score}" for name, score in scores.items()]
    run = shlex.quote(str(trained.run.path))
    lines += [
        f"run: {trained.run.path}",
        "next:",
        *(f"  {command}" for command in training.list_next_commands(trained)),
    ]
    lines.append(f"  rlctl train --resume {run} -n {2 * trained.steps}")
    for line in lines:
        output.out().print(line)
