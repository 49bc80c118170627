"""Reward terms that tasks share: pure functions of numbers, without weights."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the Euclidean distance between two points of shape (3,), in their unit."""
    x, y, z = (a - b).tolist()
    return float((x * x + y * y + z * z) ** 0.5)


def closeness(distance: float, scale: float) -> float:
    """Return 1 at distance 0, falling smoothly to 1/e at `scale` and to nothing beyond: exp(-(distance / scale)^2)."""
    return math.exp(-((distance / scale) ** 2))


def squared(x: NDArray[np.floating]) -> float:
    """Return the mean of the squared elements: in [0, 1] for an action in [-1, 1], whatever its size."""
    return float(x.dot(x)) / x.size
