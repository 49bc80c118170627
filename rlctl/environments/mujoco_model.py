"""Read names, limits and masses from the model of any environment that MuJoCo simulates, such as Gymnasium's.

Nothing here imports MuJoCo; an environment that uses it has imported it.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from rlctl.task.motors import Joints

if TYPE_CHECKING:
    import gymnasium
    import mujoco


_SHOWN_JOINTS = 8


def find_mujoco(env: gymnasium.Env[Any, Any]) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
    """Return the MuJoCo `model` and `data` of an environment, or None."""
    library, inner = sys.modules.get("mujoco"), getattr(env, "unwrapped", env)
    if library is None:
        return None
    world = getattr(inner, "sim", None) if type(getattr(inner, "sim", None)).__name__ == "MujocoSim" else inner
    model, data = (getattr(world, name, None) for name in ("model", "data"))
    if not isinstance(model, library.MjModel) or not isinstance(data, library.MjData):
        return None
    return model, data


def describe_model(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return `control_dt` [s] and `joints` of an environment that MuJoCo simulates; empty for any other."""
    simulation = find_mujoco(env)
    if simulation is None:
        return {}
    dt = getattr(env.unwrapped, "dt", None)  # not from the frame rate, which is rounded: 67 for a step of 0.015 s
    step = {"control_dt": float(dt)} if isinstance(dt, float | int) and dt > 0 else {}
    size = int(np.prod(env.action_space.shape or ()))
    return {**step, "joints": _describe_joints(simulation[0]) if size == simulation[0].nu else None}


def describe_mujoco_model(env: gymnasium.Env[Any, Any]) -> str:
    """Return the mass of a model in MuJoCo, and its joints with their limits; empty for any other environment."""
    simulation = find_mujoco(env)
    if simulation is None:
        return ""
    model, joints = simulation[0], []
    for joint in np.flatnonzero(model.jnt_type >= int(sys.modules["mujoco"].mjtJoint.mjJNT_SLIDE)):
        low, high = model.jnt_range[joint]
        limits = f" {low:.3g} to {high:.3g}" if model.jnt_limited[joint] else ""
        joints.append(f"{joint_name(model, int(joint))}{limits}")
    more = f" and {len(joints) - _SHOWN_JOINTS} more" if len(joints) > _SHOWN_JOINTS else ""
    return f"{total_mass(model):.4g} kg; joints: {', '.join(joints[:_SHOWN_JOINTS])}{more}"


def _describe_joints(model: mujoco.MjModel) -> Joints | None:
    """Describe the joints that the actuators move, in their order; None if one moves something else."""
    import mujoco

    joint_kind, no_bias = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtBias.mjBIAS_NONE)
    if not model.nu or any(int(kind) != joint_kind for kind in model.actuator_trntype):
        return None
    moved = model.actuator_trnid[:, 0]
    ranges, limited = model.jnt_range[moved], model.jnt_limited[moved].astype(bool).all()
    strengths = np.abs(model.actuator_gainprm[:, 0] * model.actuator_gear[:, 0]) * np.abs(model.actuator_ctrlrange).max(
        axis=1
    )
    motors = all(int(kind) == no_bias for kind in model.actuator_biastype) and model.actuator_ctrllimited.all()
    return Joints(
        names=[joint_name(model, joint) for joint in moved],
        low=ranges[:, 0].tolist() if limited else (),
        high=ranges[:, 1].tolist() if limited else (),
        max_torque=strengths.tolist() if motors else (),
    )


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or its number if it has no name."""
    return model.joint(int(joint)).name or f"joint {joint}"


def total_mass(model: mujoco.MjModel) -> float:
    """Return the mass of all bodies [kg]."""
    return float(model.body_mass.sum())
