"""`params/deploy.yaml` of unitree_rl_lab, which its training in Isaac Lab writes.

Two orders of joints: default positions, action and observations are in the policy's, stiffness and damping in that of
the robot's motors; `joint_ids_map` has the motor of each joint of the policy. A scale comes after the clip.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rlctl.errors import UsageError, check_name
from rlctl.importing.foreign.draft import Draft, pick, refuse_motion
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.task.mujoco.robot import Robot

TITLE = "deploy.yaml of unitree_rl_lab"
TERMS = {
    "base_ang_vel": "gyroscope",
    "base_lin_vel": "velocity",
    "projected_gravity": "gravity",
    "velocity_commands": "command",
    "generated_commands": "command",
    "joint_pos_rel": "joint_positions",
    "joint_pos": "joint_positions",
    "joint_vel_rel": "joint_velocities",
    "joint_vel": "joint_velocities",
    "last_action": "last_action",
    "actions": "last_action",
    "gait_phase": "phase",
    "height_scan": "heights",
    "height_scanner": "heights",
    "motion_command": "motion",
    "motion_anchor_ori_b": "anchor_orientation",
}
"""Names of Isaac Lab's observations."""
_SCAN_OFFSET = 0.5  # [m], that Isaac Lab's height_scan subtracts
_ABSOLUTE = "joint_pos"
_POSITION = "JointPositionAction"
_LEGS = ("FR", "FL", "RR", "RL")  # the order of the motors of Unitree's quadrupeds


def matches(content: Mapping[str, Any]) -> bool:
    """Return whether a file has this form."""
    return "joint_ids_map" in content and "observations" in content


def read(content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
    """Return what the file says; raises `UsageError` for what rlctl does not know."""
    order, default = content["joint_ids_map"], content.get("default_joint_pos")
    draft = Draft(source, {})
    motors = _order_motors(robot, draft)
    values = draft.values
    values["joints"] = pick(motors, order, source, "joint_ids_map")
    values["default_positions"] = default
    for name in ("stiffness", "damping"):
        if name in content:
            values[name] = pick(content[name], order, source, name)
    values["control_dt"] = content.get("step_dt")
    _read_action(content.get("actions") or {}, default, source, draft)
    values["observations"] = [read_term(name, term, source) for name, term in dict(content["observations"]).items()]
    ranges = dict(content.get("commands") or {}).get("base_velocity", {}).get("ranges", {})
    values["commands"] = {name: ranges[name] for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z") if ranges.get(name)}
    return draft


def _order_motors(robot: Robot, draft: Draft) -> Sequence[str]:
    """Return the joints in the order of the robot's motors, to which `joint_ids_map` refers."""
    if robot.motors:
        draft.notes.append(f"joint_ids_map: counts the actuators of {robot.path.name}")
        return robot.motors
    legs = [name.partition("_")[0] for name in robot.joints]
    if set(legs) == set(_LEGS):
        draft.notes.append(f"joint_ids_map: guessed the order {', '.join(_LEGS)} of Unitree's quadrupeds")
        return sorted(robot.joints, key=lambda name: _LEGS.index(name.partition("_")[0]))
    draft.notes.append(f"joint_ids_map: guessed that it counts the joints of {robot.path.name}")
    return robot.joints


def _read_action(actions: Mapping[str, Any], default: Any, source: str, draft: Draft) -> None:
    check = list(actions)
    if check != [_POSITION]:
        raise UsageError(f"{source}: actions are {', '.join(check) or 'missing'}; only {_POSITION} is imported")
    action = actions[_POSITION]
    if isinstance(action.get("joint_ids"), list) and None not in action["joint_ids"]:
        raise UsageError(f"{source}: the actions move some joints only, which rlctl does not import")
    draft.values["action_scale"] = action.get("scale")
    if action.get("offset") is not None and action["offset"] != default:
        raise UsageError(f"{source}: the action's offset is not default_joint_pos, which rlctl does not import")
    if action.get("clip") is not None:
        draft.notes.append("actions: the clip of joint targets is left out")


def read_term(name: str, term: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return an observation of Isaac Lab; raises `UsageError` for one that rlctl does not know."""
    if name not in TERMS:
        refuse_motion(name, source)
    check_name(name, TERMS, f"{source}: no known observation is", UsageError, listed="It knows")
    part: dict[str, Any] = {"kind": TERMS[name], "history": max(1, term.get("history_length") or 1)}
    if term.get("scale") is not None:
        part["scale"] = shorten(term["scale"])
    if term.get("clip") is not None and part["kind"] in (
        "gyroscope",
        "velocity",
        "joint_positions",
        "joint_velocities",
        "heights",
    ):
        part["clip"] = term["clip"]
    if part["kind"] == "heights":
        offset = dict(term.get("params") or {}).get("offset", _SCAN_OFFSET)
        part["shift"] = -offset
    if name == _ABSOLUTE:
        part["relative"] = False
    if part["kind"] == "phase":
        part["period_s"] = dict(term.get("params") or {}).get("period")
    return part


def shorten(values: Any) -> Any:
    """Return one number for a list of equal ones."""
    if isinstance(values, list) and len(set(map(str, values))) == 1:
        return values[0]
    return values
