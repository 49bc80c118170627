"""Types of a recipe's fields: a number is no text and no bool, and a switch is no number."""

from __future__ import annotations

from typing import Annotated, Any

import pydantic

from rlctl.errors import short_repr


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected a number, got {_quoted(value)}")
    return value


def _whole(value: Any) -> Any:
    number = _number(value)
    return int(number) if isinstance(number, float) and number.is_integer() else number


def _switch(value: Any) -> Any:
    if not isinstance(value, bool):
        raise ValueError(f"expected true or false, got {_quoted(value)}")
    return value


def _quoted(value: Any) -> str:
    return repr(short_repr(value)) if isinstance(value, str) else short_repr(value)


Whole = Annotated[int, pydantic.BeforeValidator(_whole)]
"""A whole number; `1e6` is one."""
Number = Annotated[pydantic.FiniteFloat, pydantic.BeforeValidator(_number)]
"""A finite number."""
Switch = Annotated[bool, pydantic.BeforeValidator(_switch)]
"""true or false."""
