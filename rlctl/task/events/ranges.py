"""Ranges from which events draw values: how they are written, the limits of their values, and how they widen."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np

from rlctl.errors import TaskError, did_you_mean

Range = tuple[float, float]
"""A range of random values, as a parameter of an event function: lowest and highest value.

A task or a recipe writes `[low, high]`, one number, or `{"from": [low, high], "to": [low, high]}` for a range that
goes from the first to the second as the environment's level goes from 0 to 1.
"""


@dataclasses.dataclass(frozen=True)
class RangeLimits:
    """RangeLimits of the values of a range, in its annotation: `Annotated[Range, RangeLimits(low=0.0)]`."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """Whether `low` itself is excluded."""
    whole: bool = False
    """Whole numbers only; the upper end of the range is included."""

    def find_violation(self, value: float) -> str:
        """Return why a value is outside the limits; empty if it is inside."""
        if self.whole and value != int(value):
            return f"{value:g} is not a whole number"
        if value < self.low or (self.above and value == self.low):
            return f"{value:g} is not {'above' if self.above else 'at least'} {self.low:g}"
        return f"{value:g} is not at most {self.high:g}" if value > self.high else ""


Positive = Annotated[Range, RangeLimits(0.0, above=True)]
NotNegative = Annotated[Range, RangeLimits(0.0)]
Fraction = Annotated[Range, RangeLimits(0.0, 1.0)]
Steps = Annotated[Range, RangeLimits(0.0, whole=True)]


class Widening(NamedTuple):
    """A range at level 0 and at level 1."""

    start: Range
    end: Range
    whole: bool = False

    def at(self, level: float) -> Range:
        """Return the range at a level in [0, 1]: each end moves on a straight line."""
        low, high = ((1 - level) * first + level * last for first, last in zip(self.start, self.end, strict=True))
        return (round(low), round(high)) if self.whole else (low, high)


def read_range(where: str, value: Any, limits: RangeLimits, error: type[Exception] = TaskError) -> Widening:
    """Read the range that a task or a recipe gives; raises `error` with a message that begins with `where`."""
    if not isinstance(value, Mapping):
        pair = _pair(where, value, limits, error)
        return Widening(pair, pair, limits.whole)
    for key in value:
        if key not in ("from", "to"):
            raise error(f"{where}: no key {key!r} in a range.{did_you_mean(str(key), ['from', 'to'])} {_EXPECTED}")
    for key in ("from", "to"):
        if key not in value:
            raise error(f"{where}: {key!r} is missing. {_EXPECTED}")
    start = _pair(f"{where}.from", value["from"], limits, error)
    return Widening(start, _pair(f"{where}.to", value["to"], limits, error), limits.whole)


_EXPECTED = "Write [low, high], a number, or {from: [low, high], to: [low, high]}."


def _pair(where: str, value: Any, limits: RangeLimits, error: type[Exception]) -> Range:
    numbers = list(value) if isinstance(value, list | tuple | np.ndarray) else [value, value]
    if len(numbers) != 2 or not all(_is_number(number) for number in numbers):
        raise error(f"{where}: {value!r} is not a range of finite numbers. {_EXPECTED}")
    low, high = (float(number) for number in numbers)
    if low > high:
        raise error(f"{where}: [{low:g}, {high:g}] is reversed. Write the lower value first: [{high:g}, {low:g}].")
    for number in (low, high):
        if violation := limits.find_violation(number):
            raise error(f"{where}: {violation}.")
    return low, high


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)
