"""`Style`: the poses and speeds of clips as a set, for rewards that want a robot to move like them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.task.motion import MotionClip

_ROUNDING = 1e-3
"""[rad^2], more than the products of matrices are rounded by."""


class Style:
    """The rows of clips in no order: a robot has the style where its joints are near any row, whenever that is.

    `other_side` has, for each joint, the joint of the other side, counted from 1, negative if it turns the other way:
    then mirror images of the rows count too. `horizon_s` [s] makes differences of speed comparable with those of
    positions: a difference of 1 rad/s counts as 0.05 rad.
    """

    def __init__(
        self,
        motions: Sequence[MotionClip],
        joint_order: Sequence[str],
        control_dt: float,
        other_side: Sequence[int] = (),
        horizon_s: float = 0.05,
    ) -> None:
        self.horizon_s, rows = horizon_s, []
        for motion in motions:
            positions = motion.resample(1.0 / control_dt).take_joints(joint_order)
            rows.append(self._join(positions, np.gradient(positions, control_dt, axis=0)))
        table = np.concatenate(rows)
        if len(other_side):
            index, sign = np.abs(other_side) - 1, np.sign(other_side)
            both, signs = np.concatenate([index, index + len(index)]), np.concatenate([sign, sign])
            table = np.concatenate([table, signs * table[:, both]])
        self._table, self._rough = table, table.astype(np.float32)
        self._lengths = np.square(self._rough).sum(axis=1)

    def _join(self, positions: NDArray[np.float64], velocities: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([positions, self.horizon_s * velocities], axis=1)

    def measure(self, positions: NDArray[np.float64], velocities: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far joints are from the nearest row, the root of the mean square [rad], shape (worlds,).

        Positions [rad] and velocities [rad/s] have the shape (worlds, joints).
        """
        now = self._join(positions, velocities)
        # |a - b|^2 = |b|^2 - 2 a b + |a|^2: one product of matrices for all worlds and rows. Its last bits depend on
        # the number of worlds, so the rows that may be the nearest are compared again, each for itself.
        rough = self._lengths - 2.0 * now.astype(np.float32) @ self._rough.T
        is_far = rough > rough.min(axis=1, keepdims=True) + _ROUNDING  # false for a world that is not finite
        worlds, rows = np.nonzero(~is_far)
        squares = np.square(now[worlds] - self._table[rows]).sum(axis=1)
        nearest = np.minimum.reduceat(squares, np.flatnonzero(np.diff(worlds, prepend=-1)))
        found: NDArray[np.float64] = np.sqrt(nearest / positions.shape[1])
        return found
