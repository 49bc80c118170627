"""Inverse kinematics by damped least squares (Wampler 1986)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rlctl.task.body import Array

if TYPE_CHECKING:
    from rlctl.task.mujoco.owner import BodyOwner
    from rlctl.task.mujoco.parts import Parts

_STEPS, _CLOSE, _DAMPING = 100, 1e-4, 0.05  # -, [m] and [rad], -
_LONGEST = 0.3  # [rad or m], of a step of one joint


def solve(sim: BodyOwner, parts: Parts, link: int, position: Array, turn: Array | None) -> Array:
    """Return joint positions, shape (joints,), that bring a link's frame to a pose; `turn` is (w, x, y, z)."""
    mujoco, model, data = sim.mujoco, sim.model, sim.world.scratch
    data.qpos[:] = sim.data.qpos
    size = 3 if turn is None else 6
    errors, jacobians = np.zeros(6), np.zeros((6, model.nv))  # of the position, then of the orientation
    inverse, difference = np.zeros((2, 4))
    error, jacobian = errors[:size], jacobians[:size]
    dofs = np.arange(model.nv)[parts.velocities]
    damping = _DAMPING**2 * np.eye(size)
    for _ in range(_STEPS):
        mujoco.mj_kinematics(model, data)
        errors[:3] = position - data.xpos[link]
        if turn is not None:
            mujoco.mju_negQuat(inverse, data.xquat[link])
            mujoco.mju_mulQuat(difference, turn, inverse)
            mujoco.mju_quat2Vel(errors[3:], difference, 1.0)
        if np.abs(error).max() < _CLOSE:
            break
        mujoco.mj_comPos(model, data)
        mujoco.mj_jac(model, data, jacobians[:3], jacobians[3:], data.xpos[link], link)
        matrix = jacobian[:, dofs]
        step = matrix.T @ np.linalg.solve(matrix @ matrix.T + damping, error)
        step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-9))
        data.qpos[parts.positions] = np.clip(data.qpos[parts.positions] + step, parts.low, parts.high)
    found: Array = data.qpos[parts.positions].copy()
    return found
