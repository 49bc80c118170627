"""`config.yaml` of rl_sar, with `base.yaml` of the robot in the folder above.

`joint_mapping` has the joint of the robot for each of the policy; all lists in `config.yaml` are in the policy's order.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.errors import UsageError, check_name
from rlctl.importing.foreign.draft import Draft, pick, refuse_motion
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.storage import yaml_text
from rlctl.task.mujoco.robot import Robot

TITLE = "config.yaml and base.yaml of rl_sar"
_TERMS = {
    "lin_vel": "velocity",
    "ang_vel": "gyroscope",
    "gravity_vec": "gravity",
    "commands": "command",
    "dof_pos": "joint_positions",
    "dof_vel": "joint_velocities",
    "actions": "last_action",
    "whole_body_tracking/motion_command": "motion",
    "whole_body_tracking/motion_anchor_ori_b": "anchor_orientation",
}
_SCALES = {
    "lin_vel": "lin_vel_scale",
    "ang_vel": "ang_vel_scale",
    "commands": "commands_scale",
    "dof_pos": "dof_pos_scale",
    "dof_vel": "dof_vel_scale",
}
_MOST_ABOVE = 4  # folders
_WIDE = 100.0  # clips from here on never act


def matches(content: Mapping[str, Any]) -> bool:
    """Return whether a file has this form."""
    return len(content) == 1 and all(isinstance(inner, dict) and "rl_kp" in inner for inner in content.values())


def read(content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
    """Return what the two files say; raises `UsageError` for what rlctl does not know."""
    ((title, config),) = content.items()
    base = _read_base(Path(source), str(title).partition("/")[0])
    merged = {**base, **config}
    order = merged.get("joint_mapping") or list(range(len(merged["rl_kp"])))
    draft = Draft(source, {})
    values = draft.values
    if "joint_names" in merged:
        values["joints"] = pick(merged["joint_names"], order, source, "joint_mapping")
    values["default_positions"] = config.get("default_dof_pos")
    values["stiffness"], values["damping"] = config["rl_kp"], config.get("rl_kd")
    values["max_torque"] = config.get("torque_limits", ())
    values["action_scale"] = config.get("action_scale")
    if "clip_actions_lower" in config and "clip_actions_upper" in config:
        values["action_clip"] = [config["clip_actions_lower"], config["clip_actions_upper"]]
    if "dt" in merged and "decimation" in merged:
        values["physics_dt"], values["control_dt"] = merged["dt"], merged["dt"] * merged["decimation"]
    wheels = config.get("wheel_indices") or []
    if wheels and "joints" in values:
        values["wheels"] = pick(values["joints"], wheels, source, "wheel_indices")
    ages = config.get("observations_history") or [0]
    values["history_order"] = "terms" if config.get("observations_history_priority") == "term" else "frames"
    values["newest_first"] = len(ages) > 1 and ages[0] == 0
    if sorted(ages) != list(range(len(ages))):
        raise UsageError(f"{source}: observations_history {ages} leaves steps out, which rlctl does not import")
    values["observations"] = [_read_term(name, merged, len(ages), source) for name in config["observations"]]
    if isinstance(config.get("motion_file"), str):
        draft.motion = Path(source).parent / Path(config["motion_file"]).name
    if config.get("clip_obs", _WIDE) < _WIDE:
        draft.notes.append(f"clip_obs: {config['clip_obs']:g} is left out")
    return draft


def _read_base(config: Path, robot: str) -> dict[str, Any]:
    above = config.absolute().parents[1:_MOST_ABOVE]
    file = next((folder / "base.yaml" for folder in above if (folder / "base.yaml").is_file()), None)
    if file is None:
        raise UsageError(
            f"{config}: rl_sar has the joints' names and the rate in base.yaml, in a folder above, where there is none"
        )
    content = yaml_text.load(yaml_text.read_text(file), str(file), foreign=True)
    inner = content.get(robot) if isinstance(content, dict) else None
    if not isinstance(inner, dict):
        raise UsageError(f"{file}: it has nothing about {robot!r}")
    return inner


def _read_term(name: str, config: Mapping[str, Any], history: int, source: str) -> dict[str, Any]:
    if name not in _TERMS:
        refuse_motion(name, source)
    check_name(name, _TERMS, f"{source}: no known observation is", UsageError, listed="It knows")
    part: dict[str, Any] = {"kind": _TERMS[name], "history": history}
    scale = config.get(_SCALES.get(name, ""), 1.0)
    wheels = config.get("wheel_indices") or []
    if name == "dof_pos" and wheels:  # where a wheel stands is not observed
        count = len(config["rl_kp"])
        scale = [0.0 if index in wheels else float(scale) for index in range(count)]
    if name == "ang_vel" and config.get("ang_vel_axis") == "world":
        part["frame"] = "world"
    return {**part, "scale": scale}
