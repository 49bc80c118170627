"""The parameters of a task or an environment: keyword arguments of its constructor, and fields of a `Task`."""

import inspect
import math
import re
from collections.abc import Mapping
from typing import Any

from rlctl.environments.registry import call_plugin, is_task
from rlctl.errors import RecipeError, check_name, short_repr

VAR_POSITIONAL, VAR_KEYWORD = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD


def check_given(task: str, constructor: Any, values: Mapping[str, Any]) -> None:
    """Raise `RecipeError` for parameters that a task or an environment does not have; nothing is built."""
    if is_task(constructor):
        check_fields(constructor, values)
    else:
        check_keywords(task, constructor, values)


def check_keywords(task: str, constructor: Any, parameters: Mapping[str, Any]) -> None:
    """Raise `RecipeError` if a plain environment's constructor has no parameter of that name."""
    known = read_parameters(constructor) if parameters else None
    if known is None or any(parameter.kind is VAR_KEYWORD for parameter in known.values()):
        return
    for key in parameters:
        if key != "max_episode_steps" or not hasattr(constructor, "gymnasium_id"):
            check_name(key, known, f"task.{key}: {task} has no parameter", RecipeError)


def refuse_unexpected(task: str, constructor: Any, parameters: Mapping[str, Any], error: BaseException | None) -> None:
    """Raise `RecipeError` if an error of a constructor says that it does not take one of the parameters.

    One that takes any keyword, for its base class, is only known by that.
    """
    found = re.search(r"unexpected keyword argument '(\w+)'", str(error)) if isinstance(error, TypeError) else None
    if found is None or found[1] not in parameters:
        return
    made = _find_entry_point(constructor)
    bases = made.__mro__[:-1] if isinstance(made, type) else [made]
    taken = [parameter for base in bases for parameter in inspect.signature(base).parameters.values()]
    names = [parameter.name for parameter in taken if parameter.kind not in (VAR_POSITIONAL, VAR_KEYWORD)]
    known = dict.fromkeys(names)
    check_name(found[1], known, f"task.{found[1]}: {task} has no parameter", RecipeError)


def read_parameters(constructor: Any) -> Mapping[str, inspect.Parameter] | None:
    """Return the parameters of a plain environment's constructor by name; None if they are unknown.

    For a Gymnasium id these are the parameters of its entry point.
    """
    made = _find_entry_point(constructor)
    return None if made is None else inspect.signature(made).parameters


def _find_entry_point(constructor: Any) -> Any:
    """Return what an id's constructor calls, None if that is unknown; any other constructor as it is."""
    if not hasattr(constructor, "gymnasium_id"):
        return constructor
    import gymnasium
    from gymnasium.envs.registration import load_env_creator

    spec = gymnasium.registry.get(constructor.gymnasium_id.rpartition(":")[2])
    if spec is None or spec.entry_point is None:
        return None
    return spec.entry_point if callable(spec.entry_point) else load_env_creator(spec.entry_point)


def check_fields(task: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a `Task`'s parameters, converted to the types of its fields; raises `RecipeError` for a wrong value."""
    import typing

    import pydantic

    from rlctl.storage import validation

    fields = task.parameters()
    hints = call_plugin(task.__name__, lambda: typing.get_type_hints(task)) if values else {}
    checked = {}
    for key, value in values.items():
        check_name(key, fields, f"task.{key}: {task.__name__} has no parameter", RecipeError)
        is_text = hints[key] in (int, float) and isinstance(value, bool | str)
        if is_text or (isinstance(value, float) and math.isnan(value)):  # pydantic accepts them as numbers
            raise RecipeError(f"task.{key}: expected a number, got {short_repr(repr(value))}")
        try:
            adapter = pydantic.TypeAdapter(hints[key])
        except pydantic.errors.PydanticUserError:  # a type of the author's own
            kind = getattr(hints[key], "__name__", hints[key])
            raise RecipeError(f"task.{key}: a value of type {kind} cannot be given here, only in Python") from None
        try:
            checked[key] = adapter.validate_python(value)
        except pydantic.ValidationError as error:
            raise RecipeError(validation.explain_invalid(error, adapter, value, f"task.{key}")) from None
    return checked
