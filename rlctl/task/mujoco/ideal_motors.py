"""Motors that bring a joint to a wanted velocity in one physics step, with any force up to a limit: as PyBullet's do.

A damper in MuJoCo does so as well, if it is much larger than the inertia of all that the joint moves, in contacts too:
MuJoCo takes dampers implicitly. But it computes a force that is cut by a limit from the velocity before the step, and
such a damper would then overshoot in every step. So here a step is taken without limits first, and again with a
constant force on those joints whose damper gave more than its limit.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

IDEAL_DAMPING = 1000.0
"""Damping of an ideal motor, in units of inertia / time of a physics step. A wheel moves a robot that is 100 times as
heavy for it: such a step still removes nine tenths of a difference of velocities."""
_DAMPING, _TARGET, _GAIN, _MAX_SPEED, _MAX_FORCE = range(5)
_MOST_ROUNDS = 3  # of finding motors at their limit


def make_ideal_motors(motors: int) -> NDArray[np.float64]:
    """Return the array `ideal motors` of a world: none is ideal. Shape (motors, 5)."""
    return np.zeros((motors, 5))


class SteppedWorld(Protocol):
    """A `MujocoWorld`, for its ideal motors."""

    mujoco: Any
    mj_model: Any
    mj_data: Any
    extra: dict[str, NDArray[Any]]

    def model(self, name: str) -> NDArray[Any]:
        """Return a field of the model, or one of `extra`, to change it."""


class IdealMotors:
    """The ideal motors of a single world; `MujocoWorld.extra` has their values, which a reset restores."""

    def __init__(self, world: SteppedWorld) -> None:
        self._world = world
        self._may_act = False  # whether a motor was ideal in any episode

    def switch_on(self, motors: Any, *, damping: Any, max_force: Any, gain: Any, max_speed: Any) -> None:
        """Make motors ideal; with `gain` their targets are positions, with None velocities."""
        self._may_act = True
        values = self._world.model("ideal motors")
        values[motors, _DAMPING], values[motors, _MAX_FORCE] = damping, max_force
        values[motors, _GAIN] = 0.0 if gain is None else gain
        values[motors, _MAX_SPEED] = np.inf if max_speed is None else max_speed

    def release(self, motors: Any) -> None:
        """Make motors what MuJoCo has again."""
        self._world.model("ideal motors")[motors, _DAMPING] = 0.0

    def aim_at(self, motors: Any, targets: NDArray[np.float64]) -> None:
        """Set the targets of ideal motors: positions [rad or m] or velocities."""
        self._world.model("ideal motors")[motors, _TARGET] = targets

    @property
    def is_used(self) -> bool:
        """Whether a motor is ideal."""
        values = self._world.extra.get("ideal motors") if self._may_act else None
        return values is not None and bool(values[:, _DAMPING].any())

    def step(self, substeps: int) -> None:
        """Take the physics steps of a control step; what depends on positions and velocities is up to date."""
        world = self._world
        mujoco, model, data = world.mujoco, world.mj_model, world.mj_data
        values = world.extra["ideal motors"]
        motors = np.flatnonzero(values[:, _DAMPING])
        joints = model.actuator_trnid[motors, 0]
        places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        damping, target, gain, max_speed, limit = values[motors].T
        rate = gain / model.opt.timestep
        for _ in range(substeps):
            approach = np.clip(rate * (target - data.qpos[places]), -max_speed, max_speed)
            wanted = np.where(gain > 0.0, approach, target)
            before = self._save_state()
            force = self._try_step(motors, dofs, damping, wanted, np.full(len(motors), np.nan))
            fixed = np.full(len(motors), np.nan)  # forces at their limits; NaN: the damper's
            for _ in range(_MOST_ROUNDS):
                over = np.isnan(fixed) & (np.abs(force) > limit)
                if not over.any():
                    break
                fixed[over] = np.copysign(limit, force)[over]
                self._restore_state(before)
                force = self._try_step(motors, dofs, damping, wanted, fixed)
            mujoco.mj_step1(model, data)
        # MuJoCo has the forces of dampers from the velocities before the step.
        data.qfrc_actuator[dofs] += force - data.actuator_force[motors]
        data.actuator_force[motors] = force

    def _try_step(self, motors: Any, dofs: Any, damping: Any, wanted: Any, fixed: Any) -> NDArray[np.float64]:
        """Take the second half of a physics step; return the forces of the motors."""
        world = self._world
        mujoco, model, data = world.mujoco, world.mj_model, world.mj_data
        is_damper = np.isnan(fixed)
        data.ctrl[motors] = np.where(is_damper, damping * wanted, fixed)
        model.actuator_biasprm[motors, 2] = np.where(is_damper, -damping, 0.0)
        mujoco.mj_step2(model, data)
        return np.where(is_damper, damping * (wanted - data.qvel[dofs]), fixed)

    def _save_state(self) -> NDArray[np.float64]:
        mujoco, model = self._world.mujoco, self._world.mj_model
        kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        state = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, self._world.mj_data, state, kind)
        return state

    def _restore_state(self, state: NDArray[np.float64]) -> None:
        mujoco = self._world.mujoco
        mujoco.mj_setState(self._world.mj_model, self._world.mj_data, state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
