"""Counts observations of a training that are outside their space and warns once; the training goes on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.dict_spaces import split_space
from rlctl.train.progress import Progress


class SpaceMonitor:
    """Looks at what all environments observe."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        parts = split_space(space).items()
        self._boxes = {key: part for key, part in parts if isinstance(part, spaces.Box) and part.dtype != np.uint8}
        self._outside = 0
        self._message = ""

    def look(self, observations: Mapping[str, NDArray[Any]]) -> None:
        """Count the observations that are outside; arrays of shape (observations, ...)."""
        outside: Any = False  # of each observation, once there is one
        for key, box in self._boxes.items():
            values = observations[key]
            wrong = (values < box.low) | (values > box.high)
            if wrong.any():
                outside |= wrong.reshape(len(values), -1).any(axis=1)
                self._message = self._message or _describe(key, box, values, wrong)
        self._outside += int(np.count_nonzero(outside))

    def report(self, progress: Progress) -> str | None:
        """Add what was counted since the last report to `progress`; return a warning the first time."""
        warning = None
        if self._outside and not progress.observations_outside:
            warning = f"warning: {self._message}; such observations are counted, and taken as they are"
        progress.observations_outside += self._outside
        self._outside = 0
        return warning


def _describe(key: str, box: spaces.Box, values: NDArray[Any], wrong: NDArray[np.bool_]) -> str:
    row = int(np.flatnonzero(wrong.reshape(len(values), -1).any(axis=1))[0])
    element = int(np.flatnonzero(wrong[row])[0])
    value, low, high = (each.ravel()[element] for each in (values[row], box.low, box.high))
    name = f"observation {key!r}" if key else "observation"
    return f"{name} is outside its space: element {element} is {value:.6g}, not {low:g} to {high:g}"
