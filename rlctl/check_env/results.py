"""What studies find out beside whole lives, as plain data: a class per result, sent as JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


def decode(kind: str, content: Mapping[str, Any]) -> Any:
    """Return the result that a study sent."""
    import pydantic

    return pydantic.TypeAdapter(globals()[kind]).validate_python(content)


@dataclasses.dataclass(frozen=True)
class GlobalRandom:
    """Use of random generators that belong to the whole process."""

    uses: list[GlobalUse]


@dataclasses.dataclass(frozen=True)
class GlobalUse:
    """One generator, and the first call that moved it."""

    generator: str
    """`numpy.random`, `random` or `torch`."""
    call: str
    """`build`, `reset` or `step`."""
    step: int
