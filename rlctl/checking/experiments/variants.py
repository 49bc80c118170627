"""The experiment `variants`: plays what a recipe can switch on for a task, for rules about that."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, JudgeHook, experiment
from rlctl.checking.instance import Context, EnvironmentRaised, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.values import flatten
from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RlctlError

STEPS = 60  # Of each variant: an event at an interval of a second acts in them


@dataclasses.dataclass(frozen=True)
class TaskVariants:
    """A task, of which variants can be played."""

    context: Context
    task: Any
    repeats: bool  # Whether equal seeds and actions give equal episodes


judges_variants = JudgeHook[TaskVariants]()
"""Shows a task."""


@experiment("variants", INSTANCES, 90, share=2.0, hooks=(judges_variants,))
def play_variants(context: Context) -> Iterator[ChildMessage]:
    """Play the task with all of its events and with none, and each of its stages, and compare equal seeds."""
    task: Any = getattr(getattr(context.instance.env, "unwrapped", None), "task", None)
    if not registry.is_task(type(task)):
        raise NotApplicable("events and stages are those of a rlctl.task.Task")
    try:
        repeats = is_repeatable(context, context.spec)
    except EnvironmentRaised:
        raise NotJudged("the task raises with and without its events (RL2)") from None
    yield from judges_variants.judge(TaskVariants(context, task, repeats))


def is_repeatable(context: Context, spec: EnvSpec) -> bool:
    """Say whether an episode of a variant is the same when it is played again."""
    with context.fresh(spec=spec) as instance:
        episodes = [play_variant(instance) for _ in range(2)]
    shortest = min(len(episode) for episode in episodes)  # where time was up
    return bool(np.array_equal(episodes[0][:shortest], episodes[1][:shortest]))


def play_variant(instance: Instance) -> NDArray[np.float64]:
    """Return the observations of an episode of a variant, one after the other."""
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=STEPS)
    return np.concatenate([flatten(moment.observation) for moment in episode])


def describe_cause(error: EnvironmentRaised) -> str:
    """Return what a variant raised, in a line."""
    return str(error.cause) if isinstance(error.cause, RlctlError) else str(error)
