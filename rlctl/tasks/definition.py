"""What only a `Task` says of itself: its robot, its timing, its reward, its events."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from rlctl.tasks.plain_data import to_plain

if TYPE_CHECKING:
    from rlctl.task.env import TaskEnv

_ALWAYS = ("when", "function", "enabled", "parameters")
_WHERE_IT_MEANS_SOMETHING = {"every_s": "interval", "of": "observation"}


@dataclasses.dataclass(frozen=True)
class RewardTerm:
    """A term of the reward; with weight 0 it is a metric."""

    name: str
    weight: float
    """With the recipe's changes."""
    default: float
    """As the task has it."""


@dataclasses.dataclass(frozen=True)
class OfferedEvent:
    """A random change that a task offers."""

    name: str
    when: str
    function: str
    parameters: dict[str, Any]
    """Plain data, with the recipe's changes: ranges are `[low, high]`, a number, or `{from: ..., to: ...}`."""
    enabled: bool
    """Part of the task, whatever the recipe says."""
    acts: bool
    """Whether it acts with the task's own recipe."""


@dataclasses.dataclass(frozen=True)
class Definition:
    """What a `Task` says of itself, beside what every environment does."""

    robot: str
    control_dt: float
    """Time between two actions [s]."""
    substeps: int
    """Physics steps per action."""
    episode_s: float
    """Time limit of an episode [s]."""
    has_success: bool
    action_meaning: str
    observation_layout: str
    rewards: list[RewardTerm]
    events: list[OfferedEvent]
    model_faults: list[str]
    """Links of its URDFs whose mass or inertia is missing or impossible."""


def describe_definition(env: TaskEnv) -> Definition:
    """Read a task's definition off the environment that was built for it."""
    from rlctl.task.inertia import find_inertia_faults

    task = env.task
    return Definition(
        robot=task.robot,
        control_dt=float(task.control_dt),
        substeps=int(task.substeps),
        episode_s=float(task.episode_s),
        has_success=env.has_success,
        action_meaning=task.action_meaning,
        observation_layout=task.observation_layout,
        rewards=[
            RewardTerm(name, weight, float(task.reward_weights[name])) for name, weight in env.reward_weights.items()
        ],
        events=[_describe_event(name, event, env.events.get(name)) for name, event in task.events.items()],
        model_faults=[fault for body in env.sim.bodies.values() for fault in find_inertia_faults(body)],
    )


def _describe_event(name: str, offered: Any, acting: Any) -> OfferedEvent:
    event = getattr(acting, "event", acting) or offered  # with the parameters of the recipe, where it acts
    settings = {
        key: value
        for key, value in vars(event).items()
        if not key.startswith("_") and key not in _ALWAYS and _is_set(key, value, event.when)
    }
    return OfferedEvent(
        name=name,
        when=str(event.when),
        function=str(to_plain(event.function)),
        parameters=to_plain({**event.parameters, **settings}),
        enabled=bool(offered.enabled),
        acts=acting is not None,
    )


def _is_set(key: str, value: Any, when: str) -> bool:
    return _WHERE_IT_MEANS_SOMETHING.get(key, when) == when and value not in (None, (), [], "")
