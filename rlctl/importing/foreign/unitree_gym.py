"""The YAML of unitree_rl_gym's `deploy_mujoco`; its scripts say what is observed, in an order that never changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlctl.errors import UsageError
from rlctl.importing.foreign.draft import Draft
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.task.mujoco.robot import Robot

TITLE = "YAML of unitree_rl_gym"
_PERIOD = 0.8  # [s], in the project's scripts
_WITH_PHASE = 2


def matches(content: Mapping[str, Any]) -> bool:
    """Return whether a file has this form."""
    return "kps" in content and "default_angles" in content


def read(content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
    """Return what the file says, and what the project's scripts add."""
    count = len(content["default_angles"])
    draft = Draft(source, {})
    values = draft.values
    values["default_positions"] = content["default_angles"]
    values["stiffness"], values["damping"] = content["kps"], content.get("kds")
    values["action_scale"] = content.get("action_scale")
    if "control_dt" in content:
        values["control_dt"] = content["control_dt"]
    elif "simulation_dt" in content and "control_decimation" in content:
        values["physics_dt"] = content["simulation_dt"]
        values["control_dt"] = content["simulation_dt"] * content["control_decimation"]
    observations: list[dict[str, Any]] = [
        {"kind": "gyroscope", "scale": content.get("ang_vel_scale", 1.0)},
        {"kind": "gravity"},
        {"kind": "command", "scale": content.get("cmd_scale", 1.0)},
        {"kind": "joint_positions", "scale": content.get("dof_pos_scale", 1.0)},
        {"kind": "joint_velocities", "scale": content.get("dof_vel_scale", 1.0)},
        {"kind": "last_action"},
    ]
    extra = network.observation_size - (9 + 3 * count)
    if extra == _WITH_PHASE:
        observations.append({"kind": "phase", "period_s": _PERIOD})
        draft.notes.append(f"observations: phase with a period of {_PERIOD:g} s, as in the project's scripts")
    elif extra:
        raise UsageError(
            f"{source}: {count} joints make {9 + 3 * count} observations, with a phase {11 + 3 * count}, and the "
            f"network takes {network.observation_size}"
        )
    values["observations"] = observations
    return draft
