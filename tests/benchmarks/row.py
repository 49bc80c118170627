"""A row of the table, and how two things are measured side by side."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable


@dataclasses.dataclass(frozen=True)
class Row:
    """One number to reach. `ratio` says how many times better we are, or what part of the reference."""

    what: str
    ours: str
    theirs: str
    ratio: str
    target: str
    reached: bool
    note: str
    """What was counted."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """Medians over several rounds. The ratio is that of a round: what slows a machine down slows both of a round."""

    ours: float
    theirs: float
    ratio: float
    """ours / theirs"""


def side_by_side(ours: Callable[[], float], theirs: Callable[[], float], repeat: int) -> Pair:
    """Measure the two in turn, `repeat` times each."""
    rounds = [(ours(), theirs()) for _ in range(repeat)]
    return Pair(
        statistics.median(a for a, _ in rounds),
        statistics.median(b for _, b in rounds),
        statistics.median(a / b for a, b in rounds),
    )
