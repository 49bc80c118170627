"""Motors of an arm and its gripper from the limits and inertias of a model: springs and dampers with a force limit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.tasks.grippers import Gripper
from rlctl.tasks.linkage import Linkage
from rlctl.tasks.shapes import Array

_FULL_FORCE = 0.1  # [rad or m], from the target at which a motor of the arm gives all its force
_FULL_GRIP = 0.15  # of the gripper's way
_SHORTEST = 1e-3  # [rad or m], way of a joint of the gripper
_CLOSING = 0.3  # [s], in which the gripper closes
_SAG = 0.02  # [rad or m], by which the arm's own weight moves a joint from its target, at most
_SLOWEST, _FASTEST = 15.0, 80.0  # [rad/s], of a joint's oscillation without damping
_DAMPING = 0.8  # of the critical one
_MOTOR = 400.0  # [1/s^2]: torque limit by inertia of a motor and its gears, where the file has none
_STRENGTH = 3.0  # times the torque against gravity, of a motor without a limit in the file
_ACCELERATION = 8.0  # [rad/s^2], that such a motor gives as well
_ENDLESS = 40.0  # times what a motor needs: more is no limit
_POSES = 60
_GRIP = 40.0  # force on a held block by its weight
_GRAVITY = 9.81


@dataclasses.dataclass(frozen=True)
class ChosenMotors:
    """Values of all joints, shape (joints,)."""

    stiffness: Array  # [N m/rad or N/m]
    damping: Array
    armature: Array
    max_force: Array
    notes: list[str]  # what a user should know, without a full stop


def choose_motors(linkage: Linkage, gripper: Gripper, start: Array, block_mass: float) -> ChosenMotors:
    """Return motors with which an arm holds itself, and whose gripper presses with `_GRIP` times a block's weight."""
    body, model = linkage.body, linkage.model
    inertia = _measure_inertia(linkage, start)
    own = model.dof_armature[linkage.dofs].copy()
    weight, friction = _measure_weight(linkage), model.dof_frictionloss[linkage.dofs].copy()
    needed = _STRENGTH * weight + _ACCELERATION * inertia + friction
    limits = np.where(np.isfinite(body.joint_max_force), body.joint_max_force, 0.0)
    arm = [joint for joint in range(linkage.count) if joint not in gripper.joints]
    notes = _list_notes(body.joint_names, arm, limits, needed, weight)
    is_known = (limits > 0) & (limits < _ENDLESS * needed)
    forces = np.where(is_known, limits, needed)
    grip = _measure_grip(gripper, block_mass)
    for joint, force in zip(gripper.joints, grip, strict=True):
        wanted = force + friction[joint]
        forces[joint] = min(wanted, limits[joint]) if limits[joint] > 0 else wanted
    armature = np.where(own > 0, own, forces / _MOTOR)
    # Heavy fingers crush a block before the small force of their motors stops them.
    armature[gripper.joints] = np.minimum(armature, forces / _MOTOR)[gripper.joints]
    way = _measure_way(gripper)
    moved = inertia - own + armature
    stiffness = np.maximum(forces / _FULL_FORCE, weight / _SAG)
    for joint in gripper.joints:
        stiffness[joint] = forces[joint] / (_FULL_GRIP * way[joint])
    stiffness = np.minimum(stiffness, _FASTEST**2 * moved)
    stiffness[arm] = np.maximum(stiffness, _SLOWEST**2 * moved)[arm]
    damping = 2 * _DAMPING * np.sqrt(stiffness * moved)
    for joint in gripper.joints:  # with its full force it closes fast enough
        damping[joint] = min(damping[joint], forces[joint] * _CLOSING / way[joint])
    return ChosenMotors(stiffness, damping, armature, forces, notes)


def _measure_inertia(linkage: Linkage, start: Array) -> Array:
    """Return the inertia that a torque on each joint moves at the start [kg m^2 or kg]."""
    import mujoco

    linkage.data.qpos[linkage.places] = start
    mujoco.mj_fwdPosition(linkage.model, linkage.data)
    full = np.zeros((linkage.model.nv, linkage.model.nv))
    mujoco.mj_fullM(linkage.model, linkage.data, full)
    inertia: Array = np.diag(full)[linkage.dofs].copy()
    return inertia


def _measure_weight(linkage: Linkage) -> Array:
    """Return the largest torque of gravity on each joint in some poses [N m or N]."""
    import mujoco

    rng, largest = np.random.default_rng(0), np.zeros(linkage.count)
    low, high = np.array([linkage.find_ends(joint) for joint in range(linkage.count)]).T
    linkage.data.qvel[:] = 0.0
    for _ in range(_POSES):
        linkage.data.qpos[linkage.places] = rng.uniform(low, high)
        mujoco.mj_forward(linkage.model, linkage.data)
        largest = np.maximum(largest, np.abs(linkage.data.qfrc_bias[linkage.dofs]))
    return largest


def _measure_way(gripper: Gripper) -> Array:
    """Return how far each joint moves from open to closed [rad or m], which is not 0."""
    way: Array = np.maximum(np.abs(gripper.open - gripper.closed), _SHORTEST)
    return way


def _measure_grip(gripper: Gripper, block_mass: float) -> list[float]:
    """Return the forces of a gripper's motors on a block: their work is that of the fingers on it.

    A joint that moves little gets little of it.
    """
    force = _GRIP * _GRAVITY * block_mass
    way = _measure_way(gripper)[gripper.joints]
    forces: list[float] = (force * gripper.opening * way / np.sum(way**2)).tolist()
    return forces


def _list_notes(names: Sequence[str], arm: Sequence[int], limits: Array, needed: Array, weight: Array) -> list[str]:
    missing = [names[joint] for joint in arm if limits[joint] <= 0 or limits[joint] >= _ENDLESS * needed[joint]]
    weak = [names[joint] for joint in arm if 0 < limits[joint] < weight[joint]]
    notes = []
    if missing:
        notes.append(
            f"The file has no useful effort limit for {', '.join(missing)}: MAX_FORCE of task.py has guesses, "
            f"{_STRENGTH:g} times their weight; write those of your motors"
        )
    if weak:
        notes.append(f"The effort limits of {', '.join(weak)} do not hold the arm up in every pose: correct MAX_FORCE")
    return notes
