"""The parameters of a task's or an environment's constructor, and checks of their values."""

import inspect
import math
from collections.abc import Mapping
from typing import Any

from rlctl.environments.plugin_code import call_plugin
from rlctl.errors import RecipeError, check_name, short_repr
from rlctl.storage import validation


def check_keywords(task: str, constructor: Any, parameters: Mapping[str, Any]) -> None:
    """Raise `RecipeError` if a plain environment's constructor has no parameter of that name."""
    known = read_parameters(constructor) if parameters else None
    if known is None or any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values()):
        return
    for key in parameters:
        is_of_gymnasium = key == "max_episode_steps" and hasattr(constructor, "gymnasium_id")
        if not is_of_gymnasium:
            check_name(key, known, f"task.{key}: {task} has no parameter", RecipeError)


def read_parameters(constructor: Any) -> Mapping[str, inspect.Parameter] | None:
    """Return the parameters of a plain environment's constructor by name; None if they are unknown.

    For a Gymnasium id these are the parameters of its entry point.
    """
    if hasattr(constructor, "gymnasium_id"):
        import gymnasium
        from gymnasium.envs.registration import load_env_creator

        spec = gymnasium.registry.get(constructor.gymnasium_id)
        if spec is None or spec.entry_point is None:
            return None
        constructor = spec.entry_point if callable(spec.entry_point) else load_env_creator(spec.entry_point)
    return inspect.signature(constructor).parameters


def check_fields(task: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a `Task`'s parameters, converted to the types of its fields; raises `RecipeError` for a wrong value."""
    import typing

    import pydantic

    fields = task.parameters()
    hints = call_plugin(task.__name__, lambda: typing.get_type_hints(task)) if values else {}
    checked = {}
    for key, value in values.items():
        check_name(key, fields, f"task.{key}: {task.__name__} has no parameter", RecipeError)
        _check_number(key, hints[key], value)
        adapter = pydantic.TypeAdapter(hints[key])
        try:
            checked[key] = adapter.validate_python(value)
        except pydantic.ValidationError as error:
            raise RecipeError(validation.explain_invalid(error, adapter, value, f"task.{key}")) from None
    return checked


def _check_number(key: str, hint: Any, value: Any) -> None:
    """Raise `RecipeError` for text, bools and nan, which pydantic would accept as numbers."""
    if hint in (int, float) and isinstance(value, bool | str):
        raise RecipeError(f"task.{key}: expected a number, got {short_repr(repr(value))}")
    if isinstance(value, float) and math.isnan(value):
        raise RecipeError(f"task.{key}: expected a number, got nan")
