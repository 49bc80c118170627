"""Rotations as quaternions (x, y, z, w), over any leading axes. SciPy has the same, but its import takes 0.2 s."""

import math
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


def invert(quaternions: ArrayLike) -> Array:
    """Return the inverse rotations."""
    return np.asarray(quaternions, np.float64) * (-1.0, -1.0, -1.0, 1.0)


def look_along(direction: ArrayLike) -> Array:
    """Return the axes of a camera that looks along a direction of any length, which is not vertical: to the right,
    which is level, up, and forward, as rows of shape (3, 3)."""
    forward = normalize(direction)
    right = normalize(cross(forward, np.array([0.0, 0.0, 1.0])))
    return np.stack([right, cross(right, forward), forward])


def multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the rotations that rotate by `second`, then by `first`; shapes (..., 4)."""
    one, two = np.asarray(first, np.float64), np.asarray(second, np.float64)
    (u, a), (v, b) = ((rows[..., :3], rows[..., 3:]) for rows in (one, two))
    axes = a * v + b * u + cross(u, v)
    return np.concatenate([axes, a * b - (u * v).sum(axis=-1, keepdims=True)], axis=-1)


def rotate(orientation: ArrayLike, vector: ArrayLike) -> Array:
    """Turn vectors by quaternions: from the frame with this orientation to the world; shapes (..., 4) and (..., 3)."""
    quaternions, rows = np.asarray(orientation, np.float64), np.asarray(vector, np.float64)
    axis, w = quaternions[..., :3], quaternions[..., 3:]
    twice = 2.0 * cross(axis, rows)
    return np.asarray(rows + w * twice + cross(axis, twice))


def rotate_inverse(orientation: ArrayLike, vector: ArrayLike) -> Array:
    """Turn vectors from the world to the frame with this orientation; shapes (..., 4) and (..., 3).

    `rotate_inverse(body.base_orientation, (0, 0, -1))` is the direction of gravity as an IMU measures it.
    """
    return rotate(invert(orientation), vector)


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors, shape (..., 3)."""
    # A tenth of the time of `np.cross`, which moves axes, for one row.
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    first = ay * bz - az * by
    product = np.empty((*np.shape(first), 3))
    product[..., 0] = first
    product[..., 1] = az * bx - ax * bz
    product[..., 2] = ax * by - ay * bx
    return product


def roll_pitch_yaw(orientation: Sequence[float]) -> tuple[float, float, float]:
    """Return one orientation as angles about x, y, z [rad], as PyBullet's `getEulerFromQuaternion` computes them."""
    x, y, z, w = orientation
    sine = -2 * (x * z - w * y)
    if sine <= -0.99999:
        return 0.0, -0.5 * math.pi, 2 * math.atan2(x, -y)
    if sine >= 0.99999:
        return 0.0, 0.5 * math.pi, 2 * math.atan2(-x, y)
    roll = math.atan2(2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    return roll, math.asin(sine), math.atan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
