"""Steps from measured positions as targets: what limits bound is what the drives get, not the distance to the joint."""

import dataclasses
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.limits.bounds import Bounds

Array = NDArray[np.float64]
_FARTHEST = 1e30  # [rad or m]; differences stay finite


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """Converts actions to steps from a measured position, and targets to actions; an element per joint."""

    factor: Array  # step per 1 of the action
    low: Array  # smallest and largest step
    high: Array
    space: spaces.Box

    def read(self, action: Array) -> Array:
        """Return the step of a policy's action, within its bounds."""
        return np.asarray(np.minimum(np.maximum(action * self.factor, self.low), self.high))

    def write(self, target: Array | None, position: Array | None) -> NDArray[Any]:
        """Return the action that leads from a position to a target, within its bounds; no step where one is unknown."""
        step = np.zeros(len(self.factor)) if target is None or position is None else target - position
        action = np.minimum(np.maximum(step, self.low), self.high) / self.factor
        rounded = action.astype(self.space.dtype).reshape(self.space.shape)
        return np.asarray(np.minimum(np.maximum(rounded, self.space.low), self.space.high))


def bound_targets(bounds: Bounds, space: spaces.Box) -> tuple[Bounds, Steps | None]:
    """Return the bounds of the targets in place of those of the steps, if their speed or acceleration is bounded.

    A step begins at the measured position, so its target moves with the joint: bounds of successive steps do not bound
    how fast successive targets move.
    """
    if (bounds.speed is None and bounds.change is None) or np.dtype(space.dtype).kind != "f":
        return bounds, None
    steps = Steps(bounds.factor, bounds.low, bounds.high, space)
    digits, ones = float(np.finfo(np.float64).eps), np.ones(len(bounds.names))
    low, high = np.maximum(bounds.position[0], -_FARTHEST), np.minimum(bounds.position[1], _FARTHEST)
    targets = dataclasses.replace(
        bounds, is_value=True, factor=ones, offset=0.0 * ones, low=low, high=high, position=np.array([low, high]),
        precision=8.0 * digits, resolution=digits * ones, leads_back=True,
    )  # fmt: skip
    return targets, steps
