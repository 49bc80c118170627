"""What the constructor of a task or an environment takes."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

from rlctl.tasks.plain_data import plain


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A keyword of the constructor: `--set task.<name>=...`."""

    name: str
    type: str
    """As the source has it; empty where it has none."""
    default: Any
    """Plain data; None as well where `required`."""
    required: bool


def of_task(cls: Any) -> list[Parameter]:
    """Return the parameters of a `Task` class: its dataclass fields."""
    return [_of_field(field) for field in cls.parameters().values()]


def _of_field(field: dataclasses.Field[Any]) -> Parameter:
    made = field.default_factory
    default = made() if made is not dataclasses.MISSING else field.default
    required = default is dataclasses.MISSING
    return Parameter(field.name, _annotation(field.type), None if required else plain(default), required)


def of_call(constructor: Callable[..., Any]) -> list[Parameter]:
    """Return the parameters of anything that is called to make an environment, where Python can tell.

    Without `render_mode`, which is not the user's to set.
    """
    try:
        found = inspect.signature(constructor).parameters.values()
    except (TypeError, ValueError):  # written in C
        return []
    named = [p for p in found if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and p.name != "render_mode"]
    return [
        Parameter(
            p.name,
            "" if p.annotation is p.empty else _annotation(p.annotation),
            None if p.default is p.empty else plain(p.default),
            p.default is p.empty,
        )
        for p in named
    ]


def _annotation(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
