"""Types of a recipe's values: a number is not a text and not a bool, and a switch is not a number."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Iterator
from typing import Annotated, Any

import pydantic
from annotated_types import GroupedMetadata
from pydantic_core import PydanticCustomError


class Section(pydantic.BaseModel, extra="forbid", frozen=True, use_attribute_docstrings=True):
    """A mapping in a file that people write: no other keys than these, each described by the text below it."""


Number = Annotated[float, pydantic.Strict(), pydantic.AllowInfNan(False)]
"""A finite number."""
Switch = pydantic.StrictBool
"""true or false."""


def _make_whole(value: Any) -> Any:
    if isinstance(value, numbers.Integral):  # of NumPy too
        return value if isinstance(value, bool) else int(value)
    return int(value) if isinstance(value, float) and value.is_integer() else value


Whole = Annotated[int, pydantic.Strict(), pydantic.BeforeValidator(_make_whole)]
"""A whole number; `1e6` is one."""


@dataclasses.dataclass(frozen=True)
class NumberAfter(GroupedMetadata):
    """Marks texts such as `lin_3e-4`: a prefix and a number of the type `kind`."""

    prefix: str
    kind: Any

    def __iter__(self) -> Iterator[Any]:
        yield from (pydantic.Strict(), pydantic.AfterValidator(self._check))
        yield pydantic.WithJsonSchema({"type": "string", "pattern": f"{self.prefix}NUMBER"})

    def _check(self, text: str) -> str:
        try:
            pydantic.TypeAdapter(self.kind).validate_python(float(text.removeprefix(self.prefix)))
        except ValueError:
            text = ""
        if not text.startswith(self.prefix):
            # The type's description says what would be right; see `rlctl.storage.validation`.
            raise PydanticCustomError("wrong_type", "wrong type")
        return text
