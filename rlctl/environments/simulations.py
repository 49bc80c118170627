"""Finds and describes what MuJoCo simulates in an environment."""

from __future__ import annotations

import itertools
import sys
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from rlctl.environments.driven_joints import joint_name

if TYPE_CHECKING:
    import mujoco

_SHOWN_JOINTS = 8


def find_mujoco(env: gymnasium.Env[Any, Any]) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
    """Return the MuJoCo model and data of an environment, or None.

    They are its `model` and `data`, else the first that fit each other among its attributes, or among theirs.
    """
    library, inner = sys.modules.get("mujoco"), getattr(env, "unwrapped", env)
    if library is None:
        return None
    sim = getattr(inner, "sim", None)
    world = sim if "MujocoSim" in {cls.__name__ for cls in type(sim).__mro__} else inner
    model, data = (getattr(world, name, None) for name in ("model", "data"))
    if isinstance(model, library.MjModel) and isinstance(data, library.MjData):
        return model, data
    for holder in (world, *_list_attributes(world)):
        values = _list_attributes(holder)
        models = (value for value in values if isinstance(value, library.MjModel))
        states = [value for value in values if isinstance(value, library.MjData)]
        for model, data in itertools.product(models, states):
            if data.qpos.size == model.nq and len(data.xpos) == model.nbody:
                return model, data
    return None


def _list_attributes(holder: object) -> list[Any]:
    return list(getattr(holder, "__dict__", {}).values())


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
    listed = f"; joints: {', '.join(joints[:_SHOWN_JOINTS])}{more}" if joints else ""
    return f"{model.body_mass.sum():.4g} kg{listed}"
