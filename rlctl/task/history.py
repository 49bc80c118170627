"""Histories of observations: the last values of some terms, oldest first, in the place of their newest value."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Start = Literal["first", "zeros"]
"""What fills a history when an episode begins: the first observation, or zeros before it."""


class TermHistory:
    """The histories of one world; `frames` has the number of values by name."""

    def __init__(self, frames: Mapping[str, int], start: Start) -> None:
        self._frames, self._start = frames, start
        self._kept: dict[str, list[Array]] = {}

    def begin(self) -> None:
        """Begin an episode."""
        self._kept = {}

    def add(self, parts: Mapping[str, Any]) -> dict[str, Any]:
        """Append the newest values and return the observation: shape (frames * size,) for a term with a history."""
        stacked = dict(parts)
        for name, count in self._frames.items():
            newest = np.array(parts[name], np.float64).ravel()
            filler = newest if self._start == "first" else np.zeros_like(newest)
            kept = self._kept.get(name, [filler] * count)
            self._kept[name] = kept = [*kept[1:], newest]
            stacked[name] = np.concatenate(kept)
        return stacked


class HistoryRows:
    """The histories of many worlds, as rows; `sizes` has the elements of each newest value by name, in order."""

    def __init__(self, worlds: int, sizes: Mapping[str, int], frames: Mapping[str, int], start: Start) -> None:
        newest: list[int] = []
        older: list[int] = []
        is_newest: list[bool] = []
        first = 0
        for name, size in sizes.items():
            count = frames.get(name, 1)
            newest += [first + index % size for index in range(count * size)]
            older += [len(older) + index for index in range(size, (count + 1) * size)]
            is_newest += [index >= (count - 1) * size for index in range(count * size)]
            first += size
        self._newest, self._is_newest = np.array(newest), np.array(is_newest)
        self._older = np.where(self._is_newest, 0, older)  # where the value was a step before
        self._kept = np.zeros((worlds, len(newest)))
        self._has_begun = np.zeros(worlds, bool)
        self._repeats = start == "first"

    def begin(self, worlds: NDArray[np.int64]) -> None:
        """Begin the episodes of some worlds."""
        self._has_begun[worlds] = False
        self._kept[worlds] = 0.0

    def add(self, values: Array, rows: NDArray[np.int64]) -> Array:
        """Append the newest values of some worlds, shape (k, sum of sizes); return their observations."""
        takes_newest = self._is_newest | (~self._has_begun[rows, None] & self._repeats)
        stacked: Array = np.where(takes_newest, values[:, self._newest], self._kept[rows][:, self._older])
        self._kept[rows], self._has_begun[rows] = stacked, True
        return stacked
