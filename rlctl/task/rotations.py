"""Rotations as quaternions (x, y, z, w), over any leading axes."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotate(orientation: Any, vector: Any) -> Array:
    """Turn vectors by quaternions: from the frame with this orientation to the world; shapes (..., 4) and (..., 3)."""
    axis, w = np.asarray(orientation)[..., :3], np.asarray(orientation)[..., 3:]
    twice = 2.0 * np.cross(axis, vector)
    turned: Array = vector + w * twice + np.cross(axis, twice)
    return turned


def rotate_inverse(orientation: Any, vector: Any) -> Array:
    """Turn vectors from the world to the frame with this orientation; shapes (..., 4) and (..., 3).

    `rotate_inverse(body.base_orientation, (0, 0, -1))` is the direction of gravity as an IMU measures it.
    """
    return rotate(np.asarray(orientation) * (-1.0, -1.0, -1.0, 1.0), vector)


def multiply(first: Any, second: Any) -> Array:
    """Return the rotation `second` followed by `first`; shapes (..., 4)."""
    a, b = np.asarray(first, float), np.asarray(second, float)
    axis = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    w = a[..., 3] * b[..., 3] - np.sum(a[..., :3] * b[..., :3], axis=-1)
    return np.concatenate([axis, w[..., None]], axis=-1)


def roll_pitch_yaw(orientation: Sequence[float]) -> tuple[float, float, float]:
    """Return one orientation as angles about x, y, z [rad], as PyBullet's `getEulerFromQuaternion` computes them."""
    x, y, z, w = orientation
    sine = -2 * (x * z - w * y) / (x * x + y * y + z * z + w * w)
    if sine <= -0.99999:
        return 0.0, -0.5 * math.pi, 2 * math.atan2(x, -y)
    if sine >= 0.99999:
        return 0.0, 0.5 * math.pi, 2 * math.atan2(-x, y)
    roll = math.atan2(2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    return roll, math.asin(sine), math.atan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
