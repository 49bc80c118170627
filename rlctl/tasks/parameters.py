"""What the constructor of a task or an environment takes."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

from rlctl.tasks.plain_data import to_plain


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A keyword of the constructor: `--set task.<name>=...`."""

    name: str
    type: str
    """As the source has it; empty where it has none."""
    default: Any
    """Plain data; None as well where `required`."""
    required: bool


def list_of_task(cls: Any) -> list[Parameter]:
    """Return the parameters of a `Task` class: its dataclass fields."""
    return [_describe_field(field) for field in cls.parameters().values()]


def _describe_field(field: dataclasses.Field[Any]) -> Parameter:
    made = field.default_factory
    default = made() if made is not dataclasses.MISSING else field.default
    required = default is dataclasses.MISSING
    return Parameter(field.name, _format_annotation(field.type), None if required else to_plain(default), required)


def list_of_call(constructor: Callable[..., Any]) -> list[Parameter]:
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
            "" if p.annotation is p.empty else _format_annotation(p.annotation),
            None if p.default is p.empty else to_plain(p.default),
            p.default is p.empty,
        )
        for p in named
    ]


def _format_annotation(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
