"""Describes a task from its class, one instance of its environment, and its recipe."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from pydantic_core import to_jsonable_python

from rlctl.environments import installed, registry
from rlctl.environments.leaves import Leaf, find_leaves
from rlctl.environments.registry import call_plugin
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.recipe import recipe as recipes
from rlctl.recipe import sources

if TYPE_CHECKING:
    import gymnasium

    from rlctl.task.env import TaskEnv
    from rlctl.task.events import Event


@dataclasses.dataclass(frozen=True)
class Description:
    """Everything known about a task."""

    content: dict[str, Any]  # the JSON output, as plain data
    recipe: recipes.Recipe
    policy: PolicyInfo | None  # metadata of the policy that ships with the task


def describe(task: str) -> Description:
    """Describe a task with the parameters of its recipe; its environment is built and closed.

    Raises `UsageError` for an unknown name, `TaskError` for a task that cannot be built.
    """
    constructor: Any = registry.load(task)
    recipe = sources.resolve_with_stages(task)
    # The last stage is the full task. Parts of stacked observations have no names.
    env = recipe.env_specs(task)[-1].observe_as(EnvSpec(task)).make()
    # Reading attributes of an environment also runs the plugin's code.
    try:
        about = call_plugin(task, lambda: _describe_env(task, constructor, env))
    except TaskError:
        with contextlib.suppress(TaskError):
            call_plugin(task, lambda: env.close())
        raise
    call_plugin(task, lambda: env.close())
    recipe_file, entry = registry.find_recipe_file(task), installed.find(task)
    policy_file = entry.policy_file if entry else None
    policy = PolicyFile.read_info(policy_file) if policy_file else None
    content = {
        **about,
        "recipe": recipe.model_dump(by_alias=True),
        "recipe_file": recipe_file,
        "policy_file": policy_file,
        "policy": policy and policy.model_dump(mode="json", include={"algo", "training_steps", "provenance"}),
    }
    return Description(to_jsonable_python(content, inf_nan_mode="null", fallback=_convert), recipe, policy)


def _convert(value: Any) -> Any:
    """Return the JSON form of an array (its numbers) or a function (its name)."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else getattr(value, "__name__", repr(value))


def _describe_env(task: str, constructor: Any, env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    from rlctl.environments.info import describe_model
    from rlctl.environments.simulations import find_mujoco
    from rlctl.environments.wrappers import find_time_limit
    from rlctl.task.env import TaskEnv

    built = env.unwrapped
    task_env = built if isinstance(built, TaskEnv) else None
    definition = task_env.task if task_env else built
    cls = type(definition)
    target = f"{cls.__module__}:{cls.__qualname__}"
    distribution, version = _find_origin(task, target)
    model, simulated = describe_model(env), find_mujoco(env)
    # Gymnasium's constructor of an id accepts any arguments; the class itself does not.
    called = cls if task_env or hasattr(constructor, "gymnasium_id") else constructor
    return {
        "task": task,
        "target": target,
        "summary": _find_summary(cls),
        "distribution": distribution,
        "version": version,
        "file": _find_file(cls),
        "observation_space": _format_space(env.observation_space),
        "observations": _list_observations(task_env) if task_env else _list_quantities(env.observation_space),
        "action_space": _format_space(env.action_space),
        "actions": _list_quantities(env.action_space),
        "parameters": [] if task_env and not dataclasses.is_dataclass(cls) else _list_parameters(called),
        "max_steps": task_env.max_steps if task_env else find_time_limit(env),
        "control_dt": task_env.task.control_dt if task_env else model.get("control_dt"),
        "joints": task_env.task.describe_joints() if task_env else model.get("joints"),
        "mass": float(simulated[0].body_mass.sum()) if simulated else None,
        "definition": _describe_definition(task_env) if task_env else None,
    }


def _describe_definition(env: TaskEnv) -> dict[str, Any]:
    from rlctl.task.model_faults import find_frames, find_model_faults

    task, bodies = env.task, env.sim.bodies.values()
    return {
        "robot": type(task).robot,
        "control_dt": task.control_dt,
        "substeps": task.substeps,
        "episode_s": task.episode_s,
        "has_success": env.has_success,
        "action_meaning": task.action_meaning,
        "observation_layout": task.observation_layout,
        "cameras": {
            name: {"size": list(camera.size), "body": camera.body or None, "link": camera.link or None}
            for name, camera in task.cameras.items()
        },
        "rewards": [
            {"name": name, "weight": weight, "default": float(task.reward_weights[name])}
            for name, weight in env.reward_weights.items()
        ],
        "events": [
            _describe_event(name, event, env.events[name].event if name in env.events else None)
            for name, event in task.events.items()
        ],
        "model_faults": [fault for body in bodies for fault in (*find_model_faults(body), find_frames(body)) if fault],
    }


def _describe_event(name: str, offered: Event, acting: Event | None) -> dict[str, Any]:
    event = acting or offered  # `acting` has the parameters of the recipe
    settings: dict[str, Any] = {"every_s": event.every_s} if event.when == "interval" else {}
    if event.when == "observation" and event.of:
        settings = {"of": event.of}
    parameters, acts = {**event.parameters, **settings}, {"enabled": offered.enabled, "acts": acting is not None}
    return {"name": name, "when": event.when, "function": event.function, "parameters": parameters, **acts}


def _list_parameters(constructor: Callable[..., Any]) -> list[dict[str, Any]]:
    """Return the parameters of a constructor without `render_mode`; empty if Python cannot inspect it."""
    try:
        accepted = inspect.signature(constructor).parameters.values()
    except (TypeError, ValueError):  # written in C
        return []
    fields = getattr(constructor, "__dataclass_fields__", {})
    parameters = []
    for p in accepted:
        if p.kind not in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) or p.name == "render_mode":
            continue
        kind = "" if p.annotation is p.empty else p.annotation
        kind = kind if isinstance(kind, str) else inspect.formatannotation(kind)
        default = None if p.default is p.empty else p.default
        if p.name in fields and (make := fields[p.name].default_factory) is not dataclasses.MISSING:
            default = make()
        if isinstance(default, float) and not math.isfinite(default):
            default = str(default)
        parameters.append({"name": p.name, "type": kind, "default": default, "required": p.default is p.empty})
    return parameters


def _find_origin(task: str, target: str) -> tuple[str | None, str | None]:
    entry = installed.find(task) or next(
        (candidate for candidate in installed.list_installed() if candidate.target == target), None
    )
    if entry is not None:
        return entry.distribution, entry.version
    if task.rpartition(":")[0].endswith(".py"):  # another package may have a module of that name
        return None, None
    names = importlib.metadata.packages_distributions().get(target.partition(":")[0].partition(".")[0])
    return (names[0], importlib.metadata.version(names[0])) if names else (None, None)


def _find_summary(cls: type) -> str:
    """Return the first line of a class's own docstring that is not a heading."""
    text = (cls.__dict__.get("__doc__") or "").strip()
    if text.startswith(f"{cls.__name__}("):  # a dataclass without a docstring gets its signature for one
        return ""
    return next((line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")), "")


def _find_file(cls: type) -> str | None:
    try:
        return str(Path(inspect.getfile(cls)).resolve())
    except (TypeError, OSError):  # built in, or made in a session
        return None


def _format_space(space: Any) -> str:
    return " ".join(str(space).split())


def _list_observations(env: TaskEnv) -> list[dict[str, Any]]:
    units = env.task.observation_units
    parts = _list_quantities(env.observation_space)
    if not isinstance(env.observation_space, spaces.Dict):
        (whole,) = find_leaves(env.observation_space)
        parts, start = [], 0
        for name, size in env.observation_sizes.items():
            parts.append(_describe_part(name, whole, [size], slice(start, start := start + size)))
    return [{**part, "unit": units.get(part["name"])} for part in parts]


def _list_quantities(space: Any) -> list[dict[str, Any]]:
    return [_describe_part(".".join(map(str, leaf.path)), leaf, list(leaf.shape)) for leaf in find_leaves(space)]


def _describe_part(name: str, leaf: Leaf, shape: list[int], part: Any = ...) -> dict[str, Any]:
    """Describe a named part of an observation or action; `low` and `high` are the bounds over its elements."""
    low = None if leaf.low is None or 0 in shape else float(np.min(leaf.low[part]))
    high = None if leaf.high is None or 0 in shape else float(np.max(leaf.high[part]))
    kind = {"kind": leaf.kind, "shape": shape, "dtype": leaf.dtype}
    return {"name": name, **kind, "low": low, "high": high, "unit": None}
