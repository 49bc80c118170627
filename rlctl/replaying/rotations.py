"""Rotations as quaternions (x, y, z, w), of shape (..., 4). SciPy has the same, but its import takes 0.2 s."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def normalize(quaternions: ArrayLike) -> Array:
    """Return unit quaternions, which the other functions expect."""
    rows = np.asarray(quaternions, np.float64)
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True))


def from_axis(axis: Sequence[float] | Array, angles: ArrayLike) -> Array:
    """Return the rotations about an axis of any length by angles [rad], shape (..., 4) for angles of shape (...)."""
    halves = np.asarray(angles, np.float64)[..., None] / 2
    return np.concatenate([np.sin(halves) * np.asarray(axis) / np.linalg.norm(axis), np.cos(halves)], axis=-1)


def invert(quaternions: Array) -> Array:
    """Return the inverse rotations."""
    return quaternions * (-1.0, -1.0, -1.0, 1.0)


def multiply(first: Array, second: Array) -> Array:
    """Return the rotations that rotate by `second`, then by `first`."""
    (u, a), (v, b) = ((rows[..., :3], rows[..., 3:]) for rows in (first, second))
    axes = a * v + b * u + np.cross(u, v)
    return np.concatenate([axes, a * b - (u * v).sum(axis=-1, keepdims=True)], axis=-1)


def rotate(quaternions: Array, vectors: ArrayLike) -> Array:
    """Rotate vectors of shape (..., 3)."""
    axes, scalars, rows = quaternions[..., :3], quaternions[..., 3:], np.asarray(vectors, np.float64)
    across = 2.0 * np.cross(axes, rows)
    return np.asarray(rows + scalars * across + np.cross(axes, across))
