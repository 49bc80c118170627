"""Inverse kinematics by damped least squares (Wampler 1986)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.task.body import Array

if TYPE_CHECKING:
    from rlctl.task.mujoco.owner import BodyOwner
    from rlctl.task.mujoco.parts import Parts

_STEPS, _CLOSE, _DAMPING = 100, 1e-4, 0.05  # -, [m] and [rad], -
_LONGEST = 0.3  # [rad or m], of a step of one joint


def solve(sim: BodyOwner, parts: Parts, link: int, position: Array, turn: Array | None) -> Array:
    """Return joint positions, shape (joints,), that bring a link's frame to a pose; `turn` is (w, x, y, z)."""
    mujoco, model = sim.mujoco, sim.model
    data: Any = mujoco.MjData(model)
    data.qpos[:] = sim.data.qpos
    linear, angular = np.zeros((2, 3, model.nv))
    dofs = np.arange(model.nv)[parts.velocities]
    for _ in range(_STEPS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        error, jacobian = position - data.xpos[link], linear
        mujoco.mj_jac(model, data, linear, angular, data.xpos[link], link)
        if turn is not None:
            difference, inverse, missing = np.zeros(4), np.zeros(4), np.zeros(3)
            mujoco.mju_negQuat(inverse, data.xquat[link])
            mujoco.mju_mulQuat(difference, turn, inverse)
            mujoco.mju_quat2Vel(missing, difference, 1.0)
            error, jacobian = np.concatenate([error, missing]), np.concatenate([linear, angular])
        if np.abs(error).max() < _CLOSE:
            break
        matrix = jacobian[:, dofs]
        step = matrix.T @ np.linalg.solve(matrix @ matrix.T + _DAMPING**2 * np.eye(len(error)), error)
        step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-9))
        data.qpos[parts.positions] = np.clip(data.qpos[parts.positions] + step, parts.low, parts.high)
    found: Array = data.qpos[parts.positions].copy()
    return found
