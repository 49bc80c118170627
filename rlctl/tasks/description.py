"""What a task is, read off its class, one instance of its environment, and its recipe."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl import registry
from rlctl.check_env.leaves import Leaf, find_leaves
from rlctl.errors import TaskError
from rlctl.plugin_code import call_plugin
from rlctl.run import recipe as recipes
from rlctl.run import recipe_sources
from rlctl.run.policy import PolicyInfo, read_info
from rlctl.tasks import parameters
from rlctl.tasks.definition import Definition, describe_definition
from rlctl.tasks.parameters import Parameter
from rlctl.tasks.plain_data import highest, lowest

if TYPE_CHECKING:
    import gymnasium

    from rlctl.task.env import TaskEnv


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A named part of an observation, or an action."""

    name: str
    kind: str
    """`Box`, `Discrete`, ..., or the name of a space that is not known here."""
    shape: list[int]
    dtype: str
    low: float | None
    """The lowest bound of all elements, in `unit`; None where one is unbounded or nothing is known."""
    high: float | None
    unit: str | None = None


@dataclasses.dataclass(frozen=True)
class Description:
    """Everything that is known of a task; plain data but for the recipe and the shipped policy."""

    task: str
    """As it was asked for."""
    target: str
    """`package.module:Class`."""
    summary: str
    """The first line of the class's docstring that is not a heading."""
    distribution: str | None
    version: str | None
    file: str | None
    observation_space: str
    observations: list[Quantity]
    action_space: str
    actions: list[Quantity]
    parameters: list[Parameter]
    max_steps: int | None
    """Steps until the time limit."""
    definition: Definition | None
    """What only a `Task` says; None for a plain Gymnasium environment."""
    recipe: recipes.Recipe
    recipe_file: str | None
    policy_file: str | None
    """The policy that ships with it."""
    policy: PolicyInfo | None


def describe(task: str) -> Description:
    """Describe what `task` names, with the parameters of its recipe; its environment is built and closed.

    Raises `UsageError` for a name that stands for nothing, `TaskError` for a task that cannot be built.
    """
    constructor: Any = registry.load(task)
    recipe = recipe_sources.resolve_packaged(task)
    # The last stage is what is wanted. The parts of stacked observations have no names.
    spec = dataclasses.replace(recipe.env_specs(task)[-1], frame_stack=1, time_feature=False)
    env = spec.make()
    # Guarded: attributes of an environment are a plugin's code too.
    try:
        description: Description = call_plugin(task, lambda: _describe(task, constructor, recipe, env))
    except TaskError:
        with contextlib.suppress(TaskError):
            call_plugin(task, lambda: env.close())
        raise
    call_plugin(task, lambda: env.close())
    return description


def _describe(task: str, constructor: Any, recipe: recipes.Recipe, env: gymnasium.Env[Any, Any]) -> Description:
    from rlctl.task.env import TaskEnv

    built = env.unwrapped
    cls = type(built.task if isinstance(built, TaskEnv) else built)
    target = f"{cls.__module__}:{cls.__qualname__}"
    distribution, version = _find_origin(task, target)
    recipe_file = registry.find_recipe_file(task)
    entry = registry.find(task)
    policy_file = entry.policy_file if entry else None
    max_steps: int | None
    if isinstance(built, TaskEnv):
        observations, accepted, max_steps = _list_observations(built), parameters.list_of_task(cls), built.max_steps
    else:
        observations = _list_quantities(env.observation_space)
        # Gymnasium's constructor of an id takes anything; the class behind it does not.
        accepted = parameters.list_of_call(cls if hasattr(constructor, "gymnasium_id") else constructor)
        max_steps = env.spec.max_episode_steps if env.spec else None
    return Description(
        task=task,
        target=target,
        summary=_find_summary(cls),
        distribution=distribution,
        version=version,
        file=_find_file(cls),
        observation_space=_format_space(env.observation_space),
        observations=observations,
        action_space=_format_space(env.action_space),
        actions=_list_quantities(env.action_space),
        parameters=accepted,
        max_steps=max_steps,
        definition=describe_definition(built) if isinstance(built, TaskEnv) else None,
        recipe=recipe,
        recipe_file=str(recipe_file) if recipe_file else None,
        policy_file=str(policy_file) if policy_file else None,
        policy=read_info(policy_file) if policy_file else None,
    )


def _find_origin(task: str, target: str) -> tuple[str | None, str | None]:
    entry = registry.find(task) or next((each for each in registry.list_installed() if each.target == target), None)
    if entry is not None:
        return entry.distribution, entry.version
    if task.rpartition(":")[0].endswith(".py"):  # any package may have a module of that name
        return None, None
    names = importlib.metadata.packages_distributions().get(target.partition(":")[0].partition(".")[0])
    return (names[0], importlib.metadata.version(names[0])) if names else (None, None)


def _find_summary(cls: type) -> str:
    # Of the class itself, not inherited; a dataclass without a docstring gets its signature for one.
    text = (cls.__dict__.get("__doc__") or "").strip()
    if text.startswith(f"{cls.__name__}("):
        return ""
    return next((line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")), "")


def _find_file(cls: type) -> str | None:
    try:
        return str(Path(inspect.getfile(cls)).resolve())
    except (TypeError, OSError):  # built in, or made in a session
        return None


def _format_space(space: Any) -> str:
    return " ".join(str(space).split())


def _list_observations(env: TaskEnv) -> list[Quantity]:
    """Return the parts of a task's observation by the names that the task gives them."""
    units = env.task.observation_units
    parts = _list_quantities(env.observation_space)
    if env.task.observation_layout == "flat":
        (whole,) = find_leaves(env.observation_space)
        parts, start = [], 0
        for name, size in env.observation_sizes.items():
            end = start + size
            parts.append(_describe_part(name, whole, [size], slice(start, end)))
            start = end
    return [dataclasses.replace(part, unit=units.get(part.name)) for part in parts]


def _list_quantities(space: Any) -> list[Quantity]:
    return [_describe_part(".".join(map(str, leaf.path)), leaf, list(leaf.shape)) for leaf in find_leaves(space)]


def _describe_part(name: str, leaf: Leaf, shape: list[int], part: Any = ...) -> Quantity:
    low = lowest(leaf.low[part]) if leaf.low is not None else None
    high = highest(leaf.high[part]) if leaf.high is not None else None
    return Quantity(name, leaf.kind, shape, leaf.dtype, low, high)
