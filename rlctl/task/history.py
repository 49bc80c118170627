"""Histories of observations: the last values of some terms, oldest first, in the place of their newest value."""

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
HistoryStart = Literal["first", "zeros"]
"""What fills a history when an episode begins: the first observation, or zeros before it."""


class TermHistory:
    """The histories of n worlds; `frames` has the number of values by name."""

    def __init__(self, worlds: int, frames: Mapping[str, int], start: HistoryStart) -> None:
        self._frames, self._start = frames, start
        self._kept: dict[str, Array] = {}  # by name, shape (worlds, frames, size); made with the first values
        self._worlds = worlds
        self._is_new = np.ones(worlds, bool)

    def begin(self, worlds: Any) -> None:
        """Begin the episodes of some worlds."""
        self._is_new[worlds] = True

    def add(self, parts: Mapping[str, Any], worlds: Any) -> dict[str, Any]:
        """Append the newest values of some worlds, each of shape (k, size), and return their observations.

        A term with a history has the shape (k, frames * size).
        """
        stacked = dict(parts)
        new = self._is_new[worlds]
        for name, count in self._frames.items():
            newest = np.array(parts[name], np.float64)
            newest = newest.reshape(len(new), math.prod(newest.shape[1:]))
            if name not in self._kept:
                self._kept[name] = np.zeros((self._worlds, count, newest.shape[1]))
            before = self._kept[name][worlds]
            if new.any():
                filler: Any = 0.0
                if self._start == "first":
                    filler = newest[new, None]
                before[new] = filler
            after = np.concatenate([before[:, 1:], newest[:, None]], axis=1)
            self._kept[name][worlds] = after
            stacked[name] = after.reshape(len(new), count * newest.shape[1])
        self._is_new[worlds] = False
        return stacked
