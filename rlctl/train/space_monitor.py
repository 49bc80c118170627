"""Counts observations that contradict their space and warns once; training goes on."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.dict_spaces import split, split_space
from rlctl.train.progress import Progress


class SpaceMonitor:
    """Looks at the observations of all environments after each step: some microseconds, for all of them together."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        leaves = split_space(space)
        self._bounds = {key: leaf for key, leaf in leaves.items() if isinstance(leaf, spaces.Box) and _can_exceed(leaf)}
        self._limits = {key: _uniform_bounds(box) for key, box in self._bounds.items()}
        self._outside = 0
        self._message = ""

    def look(self, observations: Any) -> None:
        """Count those that are outside; arrays have a row per environment."""
        parts = split(observations)
        rows: set[int] = set()
        for key, box in self._bounds.items():
            values = parts[key]
            if (limits := self._limits[key]) is not None:  # one for all elements: that is faster
                all_inside = limits[0] <= values.min() and values.max() <= limits[1]
            else:
                all_inside = not (np.count_nonzero(values < box.low) or np.count_nonzero(values > box.high))
            if not all_inside:
                rows.update(self._rows(key, box, values))
        self._outside += len(rows)

    def _rows(self, key: str, box: spaces.Box, values: NDArray[Any]) -> list[int]:
        wrong = ((values < box.low) | (values > box.high)).reshape(len(values), -1)
        if not self._message:
            env, element = np.argwhere(wrong)[0]
            value, low, high = (each.ravel()[element] for each in (values[env], box.low, box.high))
            self._message = (
                f"{_named(key)} is outside its space: element {element} is {value:.6g}, not {low:g} to {high:g}"
            )
        return [int(row) for row in np.flatnonzero(wrong.any(axis=1))]

    def report(self, progress: Progress) -> str | None:
        """Add what was counted since the last report to `progress`; return a warning the first time."""
        warning = None
        if self._outside and not progress.observations_outside:
            warning = f"warning: {self._message}; such observations are counted, and taken as they are"
        progress.observations_outside += self._outside
        self._outside = 0
        return warning


def _uniform_bounds(box: spaces.Box) -> tuple[Any, Any] | None:
    low, high = box.low.min(), box.high.max()
    return (low, high) if (box.low == low).all() and (box.high == high).all() else None


def _can_exceed(box: spaces.Box) -> bool:
    """Say whether the dtype has values that the space has not."""
    dtype: Any = box.dtype
    if np.issubdtype(dtype, np.integer):
        limits = np.iinfo(dtype)
        return bool((box.low > limits.min).any() or (box.high < limits.max).any())
    return bool(np.isfinite(box.low).any() or np.isfinite(box.high).any())


def _named(key: str) -> str:
    return f"observation {key!r}" if key else "observation"


def summarize(progress: Progress) -> str | None:
    """Return the warning for the end of a training, or None."""
    count = progress.observations_outside
    return f"warning: observations {count:,} outside their space" if count else None
