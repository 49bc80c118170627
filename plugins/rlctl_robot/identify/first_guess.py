"""A first guess of the servos' values by linear regression, and whether columns have another sign, order or unit.

Where a servo holds `stiffness * (target - position)` against inertia, friction and gravity, the difference of target
and position is linear in torque, acceleration, velocity and its sign; their factors are 1, armature, viscous and
Coulomb friction, each divided by the stiffness. Torques come from the file's masses (inverse dynamics).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.mujoco.world import import_mujoco
from rlctl_robot.identify.log import Array
from rlctl_robot.identify.motion import ServoLog
from rlctl_robot.identify.robot_model import (
    ARMATURE,
    COULOMB,
    DAMPING,
    DELAY,
    STIFFNESS,
    VISCOUS,
    RobotModel,
    Values,
)

LogRows = NDArray[np.int64]

_SMOOTHING_S = 0.12  # of positions, for velocities and accelerations
_SLOW = 0.05  # [rad/s or m/s], below which the sign of a velocity is uncertain
_DELAYS = np.arange(0.0, 0.121, 0.005)  # [s]
_LEAST_SHARE = 0.05  # of the difference that torques must explain, for the stiffness to follow from it
_MOST_ROWS = 6000
_COMPARED_ROWS, _COMPARED_DELAYS = 1000, 4  # of a comparison of signs and orders: every fourth delay


@dataclasses.dataclass(frozen=True, eq=False)
class Derivatives:
    """Smoothed positions of a log with their derivatives, shape (rows, joints) each."""

    positions: Array
    velocities: Array
    accelerations: Array


def differentiate(motion: ServoLog) -> Derivatives:
    """Return smoothed positions, velocities and accelerations, part by part."""
    from scipy.signal import savgol_filter

    rows = max(5, round(_SMOOTHING_S / motion.control_dt) // 2 * 2 + 1)
    results: list[list[Array]] = [[], [], []]
    for start, length in zip(motion.starts, motion.lengths, strict=True):
        part = motion.positions[start : start + length]
        size = min(rows, (length - 1) // 2 * 2 + 1)
        for order, found in enumerate(results):
            if size < 5:
                found.append(part if order == 0 else np.zeros_like(part))
            else:
                found.append(savgol_filter(part, size, 3, deriv=order, delta=motion.control_dt, axis=0))
    return Derivatives(*(np.concatenate(found) for found in results))


class Regression:
    """Explains a log's differences of targets and positions by torques and friction, joint by joint."""

    def __init__(self, robot: RobotModel, motion: ServoLog, rows: LogRows) -> None:
        """`rows` are those that may be used."""
        self.robot, self.motion = robot, motion
        derivatives = differentiate(motion)
        self.rows = rows[:: max(1, len(rows) // _MOST_ROWS)]
        self._derivatives = Derivatives(
            *(getattr(derivatives, field.name)[self.rows] for field in dataclasses.fields(derivatives))
        )
        self._delayed = [self._delay_commands(delay) for delay in _DELAYS]

    def find_sides(self) -> Array:
        """Return on which side of its play each link lies in the rows, -1 or 1: where its load pushes it."""
        sides: Array = -np.sign(self._compute_torques(self._derivatives))
        return sides

    def guess(self, fits_stiffness: bool) -> Values:
        """Return the values that explain the log best."""
        torques = self._compute_torques(self._derivatives)
        sizes = _measure_differences(self._derivatives, self._delayed[0])
        scores = [
            sum(self._fit(joint, torques, commands, fits_stiffness)[1] / size for joint, size in enumerate(sizes))
            for commands in self._delayed
        ]
        best = int(np.argmin(scores))
        found = np.array(
            [
                self._fit(joint, torques, self._delayed[best], fits_stiffness)[0]
                for joint in range(len(self.robot.joints))
            ]
        )
        stiffness = found[:, 0]
        if np.isnan(stiffness).all():
            inertia = 1.0 / np.maximum(self.robot.model.dof_invweight0, 1e-9)
            stiffness = inertia / np.maximum(found[:, 1], 1e-4)
        # A joint whose torques leave no trace has the usual motor of the robot.
        stiffness = np.where(np.isnan(stiffness), np.nanmedian(stiffness), stiffness)
        values = {name: value.copy() for name, value in self.robot.nominal.items()}
        values |= {STIFFNESS: stiffness, DELAY: np.array(_DELAYS[best])}
        values[ARMATURE], values[VISCOUS], values[COULOMB] = stiffness * found[:, 1:].T
        values[VISCOUS] = np.maximum(values[VISCOUS] - values[DAMPING], 0.05 * values[VISCOUS])
        return values

    def unexplained(self, signs: Array, order: Sequence[int]) -> Array:
        """Return the unexplained share of each joint if columns had other signs and another order, (joints,)."""
        few = slice(None, None, max(1, len(self.rows) // _COMPARED_ROWS))
        fields = [getattr(self._derivatives, field.name) for field in dataclasses.fields(Derivatives)]
        changed = Derivatives(*(values[few][:, order] * signs for values in fields))
        torques = self._compute_torques(changed)
        delayed = [commands[few][:, order] * signs for commands in self._delayed[::_COMPARED_DELAYS]]
        sizes = _measure_differences(changed, delayed[0])
        shares = [
            [self._fit_one(changed, joint, torques, commands, True)[1] / size for joint, size in enumerate(sizes)]
            for commands in delayed
        ]
        best = int(np.argmin(np.sum(shares, axis=1)))
        return np.array(shares[best])

    def _delay_commands(self, delay: float) -> Array:
        commands, rows = self.motion.commands, self.rows
        moment = rows - delay / self.motion.control_dt + 0.5  # a command holds for a step: its middle
        whole = np.clip(moment, 0, len(commands) - 1.001)
        row = whole.astype(int)
        part = (whole - row)[:, None]
        delayed: Array = commands[row] * (1 - part) + commands[np.minimum(row + 1, len(commands) - 1)] * part
        return delayed

    def _compute_torques(self, moved: Derivatives) -> Array:
        """Return the torques that accelerate and hold the links, without armature and friction, (rows, joints)."""
        mujoco = import_mujoco()
        model: Any = self.robot.model.__copy__()
        for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
            getattr(model, name)[:] = 0.0
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        data = mujoco.MjData(model)
        torques = np.empty_like(moved.positions)
        for row in range(len(torques)):
            data.qpos[:], data.qvel[:] = moved.positions[row], moved.velocities[row]
            data.qacc[:] = moved.accelerations[row]
            mujoco.mj_inverse(model, data)
            torques[row] = data.qfrc_inverse
        return torques

    def _fit(self, joint: int, torques: Array, commands: Array, fits_stiffness: bool) -> tuple[Array, float]:
        return self._fit_one(self._derivatives, joint, torques, commands, fits_stiffness)

    def _fit_one(
        self, moved: Derivatives, joint: int, torques: Array, commands: Array, fits_stiffness: bool
    ) -> tuple[Array, float]:
        """Return a joint's stiffness, and armature, viscous and Coulomb friction divided by it; the mean square error.

        The stiffness is NaN where torques explain so little that it is unknown.
        """
        from scipy.optimize import nnls

        velocity = moved.velocities[:, joint]
        difference = commands[:, joint] - moved.positions[:, joint]
        causes = np.stack(
            [torques[:, joint], moved.accelerations[:, joint], velocity, np.tanh(velocity / _SLOW)], axis=1
        )
        known = self.robot.nominal[STIFFNESS][joint]
        if not fits_stiffness:
            difference, causes = difference - causes[:, 0] / known, causes[:, 1:]
        sizes = np.maximum(np.sqrt(np.square(causes).mean(axis=0)), 1e-9)
        scaled, _ = nnls(causes / sizes, difference)
        factors = scaled / sizes
        rest = difference - causes @ factors
        error = float(np.square(rest).mean())
        if not fits_stiffness:
            return np.array([known, *factors]), error
        explained = scaled[0] / max(float(np.sqrt(np.square(difference).mean())), 1e-9)
        stiffness = known
        if explained > _LEAST_SHARE and factors[0] > 0:
            stiffness = 1.0 / factors[0]
        return np.array([stiffness, *factors[1:]]), error


def _measure_differences(moved: Derivatives, commands: Array) -> list[float]:
    """Return the mean square of each joint's difference of commands and positions."""
    squares = np.square(commands - moved.positions).mean(axis=0)
    return np.maximum(squares, 1e-12).tolist()
