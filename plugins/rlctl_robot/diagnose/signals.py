"""What a log holds after its columns have been assigned: observations and actions of the policy, row by row."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

ACTIONS = "actions"  # the name of the action beside the names of observations
MAX_DELAY = 4
"""Longest delay that is searched for [control steps]."""


@dataclasses.dataclass(frozen=True, eq=False)
class LoggedSignals:
    """Observations and actions, a row per control step; a segment is a part without gaps."""

    observations: Array  # shape (T, elements)
    actions: Array  # shape (T, actions): row t was computed from row t of the observations
    lengths: tuple[int, ...]  # rows of each segment
    sizes: Mapping[str, int]  # elements of each observation by name, in the policy's order

    @property
    def slices(self) -> dict[str, slice]:
        """Columns of each observation."""
        ends = np.cumsum(list(self.sizes.values())).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(self.sizes.items(), ends, strict=True)}

    @property
    def starts(self) -> list[int]:
        """First row of each segment."""
        return [0, *np.cumsum(self.lengths)[:-1].tolist()] if self.lengths else []

    def term(self, name: str) -> Array:
        """Return the columns of an observation, or the actions."""
        return self.actions if name == ACTIONS else self.observations[:, self.slices[name]]

    def join(self, other: "LoggedSignals") -> "LoggedSignals":
        """Return these segments and those of another log of the same observations."""
        return LoggedSignals(
            np.concatenate([self.observations, other.observations]),
            np.concatenate([self.actions, other.actions]),
            (*self.lengths, *other.lengths),
            self.sizes,
        )

    def inner_rows(self, margin: int) -> Array:
        """Return the rows with at least `margin` rows of the same segment on both sides."""
        parts = [
            np.arange(start + margin, start + length - margin)
            for start, length in zip(self.starts, self.lengths, strict=True)
        ]
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def shift(values: Array, steps: int, lengths: tuple[int, ...]) -> Array:
    """Return values from `steps` rows later in the same segment; at its ends the nearest row of the segment."""
    if steps == 0:
        return values
    starts = np.repeat(np.cumsum((0, *lengths[:-1])), lengths)
    ends = starts + np.repeat(lengths, lengths) - 1
    return values[np.clip(np.arange(len(values)) + steps, starts, ends)]


def rotation_matrices(angles: Array) -> Array:
    """Return matrices from the body's to the world's frame for roll, pitch, yaw [rad], shape (T, 3) -> (T, 3, 3)."""
    from scipy.spatial.transform import Rotation

    matrices: Array = Rotation.from_euler("xyz", angles).as_matrix()
    return matrices


def quaternion_matrices(quaternions: Array) -> Array:
    """Return matrices from the body's to the world's frame for quaternions (x, y, z, w), shape (T, 4) -> (T, 3, 3)."""
    from scipy.spatial.transform import Rotation

    safe = np.where(np.linalg.norm(quaternions, axis=1, keepdims=True) > 1e-6, quaternions, [0.0, 0.0, 0.0, 1.0])
    matrices: Array = Rotation.from_quat(safe).as_matrix()
    return matrices
