"""Two places that the source measures the distance of, and between what coordinates one of them gets."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.goal_distances import GoalDistance
from rlctl.checking.source_code import Expression

Array = NDArray[np.float64]

FIXED, MOSTLY_FIXED = 1e-3, 0.8  # motion of a goal that does not move [m], and the part of the episodes with one


@dataclasses.dataclass(frozen=True, eq=False)
class ComparedPlaces:
    """What a distance is measured between, in each step of each episode: NaN where it was not."""

    distance: GoalDistance
    robot: Expression
    goal: Expression
    robots: Sequence[Array]  # by episode. Shape (steps, axes)
    goals: Sequence[Array]

    @property
    def may_be_fixed(self) -> bool:
        """Whether the goal stays where it is along an axis, in most episodes."""
        still = [np.ptp(goal[np.isfinite(goal).all(axis=1)], axis=0) < FIXED for goal in self.goals if _is_known(goal)]
        return bool(still) and bool((np.mean(still, axis=0) >= MOSTLY_FIXED).any())

    def name(self, one: Expression, axis: int) -> str:
        """Return how to write an element of a place."""
        return f"{one.text}[{axis}]" if self.robots[0].shape[1] > 1 else one.text


@dataclasses.dataclass(frozen=True, eq=False)
class Bound:
    """Between what coordinates a place of the robot gets. Shape (axes,)."""

    low: Array  # infinite where it is not known
    high: Array
    how: str  # this is known
    periods: Array | None = None  # what leads to the same place, as a turn of a hinge

    def wrap(self, axis: int, rows: Array) -> Array:
        """Return the coordinates along an axis that are nearest to the middle, and lead to the same places."""
        if self.periods is None or not np.isfinite(self.periods[axis]):
            return rows
        middle = (self.low[axis] + self.high[axis]) / 2
        return np.asarray(rows - self.periods[axis] * np.round((rows - middle) / self.periods[axis]))

    def list_ends(self) -> Iterator[tuple[int, int, float]]:
        """Yield axis, sign and coordinate of each end that is known."""
        for sign, ends in ((-1, self.low), (1, self.high)):
            yield from ((axis, sign, end) for axis, end in enumerate(ends.tolist()) if np.isfinite(end))


def _is_known(goal: Array) -> bool:
    return bool(np.isfinite(goal).all(axis=1).any())
