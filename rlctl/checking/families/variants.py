"""RL0, variants: what a recipe switches on in a task works too: its events, and the stages of its curriculum."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.failures import EnvironmentRaised, describe
from rlctl.checking.instance import Context, Instance
from rlctl.checking.leaves import flatten_numbers
from rlctl.checking.records import FIRST_SEED, ChildMessage, Skipped
from rlctl.checking.rules import NotApplicable, NotJudged, RuleFinding, experiment
from rlctl.environments import info, registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError, RlctlError

if TYPE_CHECKING:
    from rlctl.environments.info import EnvInfo

STEPS = 60  # Of each variant: an event at an interval of a second acts in them


@experiment("variants", "RL011", "RL012", share=2.0)
def play_variants(context: Context) -> Iterator[ChildMessage]:
    """Play the task with all of its events and with none, and each of its stages, and compare equal seeds."""
    task: Any = getattr(getattr(context.instance.env, "unwrapped", None), "task", None)
    if not registry.is_task(type(task)):
        raise NotApplicable("events and stages are those of a rlctl.task.Task")
    try:
        repeats = _play(context, context.spec)
    except EnvironmentRaised:
        raise NotJudged("the task raises whatever the events (RL2)") from None
    if task.events:
        yield from _play_events(context, repeats)
    else:
        yield Skipped("RL011", "the task has no events", applies=False)
    if stages := _find_stages(context.spec.task, task):
        yield from _play_stages(context, stages)
    else:
        yield Skipped("RL012", "the task has no stages", applies=False)


def _find_stages(name: str, task: Any) -> Sequence[Any]:
    file = registry.find_recipe_file(name)
    stages = task.stages
    if file is not None and "stages" in file.read_text(encoding="utf-8", errors="replace"):
        from rlctl.recipe.sources import read  # pydantic's models take a quarter of a second to load

        stages = read(file).get("stages", stages)
    return stages if isinstance(stages, list | tuple) else ()  # another type is refused with the recipe


def _play_events(context: Context, repeats: bool) -> Iterator[RuleFinding]:
    for randomize in {True, False} - {context.spec.randomize}:
        where = f"with randomize={str(randomize).lower()}"
        try:
            same = _play(context, dataclasses.replace(context.spec, randomize=randomize))
        except EnvironmentRaised as error:
            yield RuleFinding("RL011", f"{where}: {_explain(error)}")
            continue
        if repeats and not same:
            yield RuleFinding("RL011", f"{where}: equal seeds and actions give unequal episodes")


def _play_stages(context: Context, stages: Sequence[Any]) -> Iterator[RuleFinding]:
    from rlctl.recipe.recipe import validate

    spec, first = context.spec, None
    settings = {"task": spec.parameters, "events": spec.events, "randomize": spec.randomize, "stages": list(stages)}
    try:
        specs = validate(settings, "stages").env_specs(spec.task)
    except RecipeError as error:
        yield RuleFinding("RL012", str(error))
        return
    for number, stage in enumerate(specs, start=1):
        try:
            info = _describe(context, stage)
        except EnvironmentRaised as error:
            yield RuleFinding("RL012", f"stage {number} of {len(specs)}: {_explain(error)}")
            continue
        first = first or info
        if difference := info.find_difference(first, "stage 1's"):
            yield RuleFinding("RL012", f"stage {number} of {len(specs)}: {difference}")


def _play(context: Context, spec: EnvSpec) -> bool:
    with context.fresh(spec=spec) as instance:
        episodes = [_record(instance) for _ in range(2)]
    shortest = min(len(episode) for episode in episodes)  # where time was up
    return bool(np.array_equal(episodes[0][:shortest], episodes[1][:shortest]))


def _describe(context: Context, spec: EnvSpec) -> EnvInfo:
    with context.fresh(spec=spec) as instance:
        _record(instance)
        return info.describe(instance.env)


def _record(instance: Instance) -> NDArray[np.float64]:
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS)
    return np.concatenate([flatten_numbers(moment.observation) for moment in episode])


def _explain(error: EnvironmentRaised) -> str:
    cause = error.__cause__ or error
    return str(cause) if isinstance(cause, RlctlError) else describe(cause)
