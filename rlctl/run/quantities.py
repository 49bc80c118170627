"""Types of a recipe's values: a number is not a text and not a bool, and a switch is not a number."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

import pydantic
from pydantic_core import PydanticCustomError, core_schema


class Section(pydantic.BaseModel):
    """A mapping in a recipe: no other keys than these, each described by the text below it."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


_WRONG = PydanticCustomError("wrong_type", "wrong type")
"""The type's description says what would be right; see `rlctl.run.schema_text`."""


def _check_number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _WRONG
    return value


def _check_whole(value: Any) -> Any:
    number = _check_number(value)
    return int(number) if isinstance(number, float) and number.is_integer() else number


def _check_switch(value: Any) -> Any:
    if not isinstance(value, bool):
        raise _WRONG
    return value


Whole = Annotated[int, pydantic.BeforeValidator(_check_whole)]
"""A whole number; `1e6` is one."""
Number = Annotated[pydantic.FiniteFloat, pydantic.BeforeValidator(_check_number)]
"""A finite number."""
Switch = Annotated[bool, pydantic.BeforeValidator(_check_switch)]
"""true or false."""


@dataclasses.dataclass(frozen=True)
class NumberAfter:
    """Marks texts such as `lin_3e-4`: a prefix and a number of the type `kind`."""

    prefix: str
    kind: Any

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        adapter = pydantic.TypeAdapter[Any](self.kind)

        def check(text: str) -> str:
            try:
                adapter.validate_python(float(text.removeprefix(self.prefix)))
            except ValueError:
                raise _WRONG from None
            if not text.startswith(self.prefix):
                raise _WRONG
            return text

        return core_schema.no_info_after_validator_function(check, core_schema.str_schema(strict=True))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        return {"type": "string", "pattern": f"{self.prefix}NUMBER"}
