"""Strict types of a recipe's values: text and bools are not numbers, and numbers are not switches."""

import dataclasses
import numbers
from collections.abc import Iterator
from typing import Annotated, Any

import pydantic
from annotated_types import GroupedMetadata
from pydantic_core import PydanticCustomError


class Section(pydantic.BaseModel, extra="forbid", frozen=True, use_attribute_docstrings=True):
    """A mapping in a file that users write. Unknown keys are errors; the text below a field describes it."""


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
    """Type of texts such as `lin_3e-4`: `prefix`, then a number of type `kind`."""

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
            # `rlctl.storage.validation` writes the message, from the type's JSON schema.
            raise PydanticCustomError("wrong_type", "wrong type")
        return text
