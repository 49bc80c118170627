"""Reward terms that tasks share: pure functions of numbers, without weights.

Terms are unsigned: the sign is in the weight. A `BatchTask` gives arrays with a leading axis of n worlds, and gets n
values, shape (n,).
"""

import math
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError

Array = NDArray[np.floating]
PerWorld = Any
"""A number; n numbers, shape (n,), for arguments with a leading axis."""
Values = TypeVar("Values", float, NDArray[np.float64])
Flags = bool | NDArray[np.bool_]


def distance(a: Array, b: Array) -> PerWorld:
    """Return the Euclidean distance between two points of shape (3,), in their unit."""
    difference = a - b
    if difference.ndim > 1:
        return _length(difference)
    x, y, z = difference.tolist()
    return float((x * x + y * y + z * z) ** 0.5)


def _length(vectors: Array) -> Array:
    lengths: Array = np.sqrt(np.square(vectors).sum(axis=-1))
    return lengths


def closeness(distance: Values, scale: float) -> Values:
    """Return exp(-(distance / scale)^2): 1 at distance 0, 1/e at `scale`, and close to 0 far beyond it."""
    if isinstance(distance, np.ndarray):
        return np.exp(-((distance / scale) ** 2))
    return math.exp(-((distance / scale) ** 2))


def arrival(distance: Values, tolerance: float) -> Values:
    """Return 1 where the distance is below `tolerance`, in the same unit, else 0."""
    return _count(distance < tolerance)


def _count(flags: Any) -> PerWorld:
    return flags.astype(np.float64) if isinstance(flags, np.ndarray) else float(flags)


def squared(x: Array) -> PerWorld:
    """Return the mean of the squared elements: in [0, 1] for an action in [-1, 1], whatever its size."""
    if x.ndim > 1:
        return np.square(x).mean(axis=-1)
    return float(x.dot(x)) / x.size


def change(x: Array, last: Array) -> PerWorld:
    """Return the mean of the squared differences between two vectors, such as an action and the one before it."""
    return squared(x - last)


def power(torques: Array, velocities: Array) -> PerWorld:
    """Return the mechanical power of the joints' motors [W]: the sum of |torque [N m] x velocity [rad/s]|."""
    powers = np.abs(torques * velocities)
    return powers.sum(axis=-1) if powers.ndim > 1 else float(powers.sum())


def forward_velocity(velocity: Array, heading: Array) -> PerWorld:
    """Return the part of a velocity [m/s] along `heading`, a direction of any length but 0; both of shape (3,)."""
    if velocity.ndim > 1 or heading.ndim > 1:
        return (velocity * heading).sum(axis=-1) / _length(heading)
    return float(np.dot(velocity, heading) / math.sqrt(np.dot(heading, heading)))


def forward_while_alive(velocity: Array, heading: Array, alive: Flags) -> PerWorld:
    """Return `forward_velocity` [m/s] while `alive`, else 0: a fall forward earns nothing."""
    if isinstance(alive, np.ndarray):
        return np.where(alive, forward_velocity(velocity, heading), 0.0)
    return forward_velocity(velocity, heading) if alive else 0.0


def alive(terminated: Flags) -> PerWorld:
    """Return 0 in a step that terminates the episode, else 1."""
    if isinstance(terminated, np.ndarray):
        return _count(~terminated)
    return 0.0 if terminated else 1.0


def posture(orientation: Array) -> PerWorld:
    """Return roll^2 + pitch^2 [rad^2] of a quaternion (x, y, z, w): 0 upright, whatever the heading.

    With the z-y-x (yaw, pitch, roll) angles of a unit quaternion: roll = atan2(2 (w x + y z), 1 - 2 (x^2 + y^2)),
    pitch = asin(2 (w y - z x)). Where the pitch is a right angle the roll is undefined, and it counts as 0.
    """
    if orientation.ndim > 1:
        return _posture_of_many(orientation)
    x, y, z, w = orientation.tolist()
    sine = 2 * (w * y - z * x)
    if abs(sine) > 0.99999:
        return (math.pi / 2) ** 2
    return math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) ** 2 + math.asin(sine) ** 2


def _posture_of_many(orientations: Array) -> Array:
    x, y, z, w = np.moveaxis(orientations, -1, 0)
    sine = 2 * (w * y - z * x)
    roll, pitch = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(np.clip(sine, -1.0, 1.0))
    return np.where(np.abs(sine) > 0.99999, (math.pi / 2) ** 2, roll**2 + pitch**2)


def fallen(height: Values, lowest: float) -> Values:
    """Return 1 if `height` is below `lowest`, the smallest height of a standing robot, both [m], else 0."""
    return _count(height < lowest)


def speed(velocity: Array) -> PerWorld:
    """Return the length of a velocity: an angular one of shape (3,) [rad/s], or a linear one [m/s]."""
    if velocity.ndim > 1:
        return _length(velocity)
    return math.sqrt(np.dot(velocity, velocity))


def grasp(distance: Any, scale: float, held: Flags) -> PerWorld:
    """Return 0.5 `closeness` to the object, plus 0.5 while it is held: in [0, 1]."""
    if isinstance(held, np.ndarray):
        return 0.5 * closeness(distance, scale) + 0.5 * held
    return 0.5 * closeness(distance, scale) + (0.5 if held else 0.0)


def time_spent(control_dt: float) -> float:
    """Return the time of one step [s], so that its weight is a cost per second whatever the control rate."""
    return control_dt


def near_limits(positions: Array, low: Array, high: Array, margin: float) -> PerWorld:
    """Return how close joints are to their limits: 0 farther away than `margin`, 1 at a limit; the mean of all joints.

    Everything in [rad] or [m], arrays of shape (joints,); beyond a limit the value rises further. A joint whose lower
    limit is not below its upper one has no limits.
    """
    inside = np.maximum(0.0, 1.0 - np.minimum(positions - low, high - positions) / margin)
    limited = np.where(low < high, inside, 0.0)
    return limited.mean(axis=-1) if limited.ndim > 1 else float(limited.mean())


def excess_force(forces: Array, limit: float) -> float:
    """Return the sum of the contact forces of one world above `limit` [N]; 0 without contacts, shape (0,)."""
    return float(np.maximum(0.0, forces - limit).sum())


def penetration(distances: Array) -> float:
    """Return the depth of one world's deepest contact [m], 0 without one; `distances` are negative for overlaps."""
    return float(np.maximum(0.0, -distances).max()) if distances.size else 0.0


Falloff = Literal["gaussian", "linear", "long_tail"]


def tolerance(
    x: Values,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    falloff: Falloff = "gaussian",
    at_margin: float = 0.1,
) -> Values:
    """Return 1 where x is inside `bounds`, falling to `at_margin` at a distance of `margin` outside them.

    With v = `at_margin` and d = distance / margin, outside the bounds the value is
    - gaussian: v^(d^2)
    - linear: 1 - (1 - v) d, not below 0
    - long_tail: 1 / (1 + (1/v - 1) d^2)

    and 0 with a margin of 0. x, `bounds` and `margin` have one unit; an array gives one value per element. Raises
    `TaskError` for reversed bounds, a negative margin and `at_margin` outside (0, 1). The idea and the shapes are
    those of `tolerance` in the DeepMind Control Suite, Tassa et al. 2018, arXiv:1801.00690, section 2.
    """
    low, high = bounds
    if low > high:
        raise TaskError(f"tolerance: bounds ({low:g}, {high:g}) are reversed")
    if margin < 0:
        raise TaskError(f"tolerance: margin {margin:g} is negative")
    if not 0 < at_margin < 1:
        raise TaskError(f"tolerance: at_margin {at_margin:g} is not between 0 and 1")
    if falloff not in _FALLOFFS:
        raise TaskError(f"tolerance: no falloff {falloff!r}. There are: {', '.join(_FALLOFFS)}")
    if isinstance(x, np.ndarray):
        outsides = np.maximum(low - x, x - high)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            beyond = (
                _FALLOFFS[falloff](outsides / margin, at_margin) if margin else np.where(outsides > 0, 0.0, outsides)
            )
        return np.where(outsides <= 0, 1.0, beyond)
    outside = max(low - x, x - high)
    if outside <= 0:
        return 1.0
    if math.isnan(outside):
        return math.nan
    return _FALLOFFS[falloff](outside / margin, at_margin) if margin else 0.0


_FALLOFFS: dict[str, Callable[[Any, float], Any]] = {
    "gaussian": lambda d, v: v ** (d * d),
    "linear": lambda d, v: np.maximum(0.0, 1 - (1 - v) * d) if isinstance(d, np.ndarray) else max(0.0, 1 - (1 - v) * d),
    "long_tail": lambda d, v: 1 / (1 + (1 / v - 1) * d * d),
}
