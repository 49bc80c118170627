"""Metadata of ONNX files that mjlab and the exporters for Isaac Lab write: `joint_names`, `action_scale` and others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError, check_name
from rlctl.importing.foreign.draft import Draft
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.importing.foreign.unitree_lab import read_term
from rlctl.task.motion import MotionClip
from rlctl.task.mujoco.robot import Robot
from rlctl.task.rotations import normalize

TITLE = "metadata of ONNX files of mjlab and Isaac Lab"
_NUMBERS = {
    "default_joint_pos": "default_positions",
    "joint_stiffness": "stiffness",
    "joint_damping": "damping",
    "action_scale": "action_scale",
}
_OBSERVATIONS = {  # names in mjlab and whole_body_tracking, and the functions of Isaac Lab that compute them
    "command": "velocity_commands",
    "twist": "velocity_commands",
    "joint_pos": "joint_pos_rel",
    "joint_vel": "joint_vel_rel",
}
_CLIP = ("joint_pos", "body_pos_w", "body_quat_w")  # tables of a clip in the graph


def matches(content: Mapping[str, Any]) -> bool:
    """Return whether metadata have this form."""
    return "joint_names" in content and "observation_names" in content


def read(content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
    """Return what the metadata say; scales of observations and the rate are not among them."""
    draft = Draft(source, {"joints": _split(content["joint_names"])})
    values = draft.values
    for key, name in _NUMBERS.items():
        if key in content:
            numbers = [float(number) for number in _split(content[key])]
            values[name] = numbers[0] if len(numbers) == 1 else numbers
    if "anchor_body_name" in content:
        values["anchor"] = str(content["anchor_body_name"])
    names = _split(content["observation_names"])
    lengths = [int(length) for length in _split(content.get("observation_history_lengths", ""))] or [1] * len(names)
    known = dict(_OBSERVATIONS)
    if content.get("command_names") == "motion":
        known["command"] = "motion_command"
    values["observations"] = [
        read_term(known.get(name, name), {"history_length": length}, source)
        for name, length in zip(names, lengths, strict=False)
    ]
    if "control_dt" in content:
        values["control_dt"] = float(content["control_dt"])
    draft.notes.append("observations: metadata have no scales; taken as 1")
    return draft


def has_clip(tables: Mapping[str, NDArray[np.float64]]) -> bool:
    """Return whether a graph contains the clip that its policy follows."""
    return all(name in tables for name in _CLIP)


def read_clip(
    content: Mapping[str, Any], tables: Mapping[str, NDArray[np.float64]], source: str, robot: Robot, rate: float
) -> MotionClip:
    """Return the clip in a graph, a row per action; raises `UsageError` if it is not of this robot."""
    names, bodies = _split(content["joint_names"]), _split(content.get("body_names", ""))
    joints, places, turns = (np.asarray(tables[name]) for name in _CLIP)
    frames = len(joints)
    if joints.shape != (frames, len(names)) or places.shape[:1] + places.shape[2:] != (frames, 3):
        raise UsageError(f"{source}: its clip has the shapes {joints.shape} and {places.shape} for {len(names)} joints")
    if bodies[:1] != list(robot.links[:1]):
        raise UsageError(
            f"{source}: its clip is of the links {', '.join(bodies)}, and the base of {robot.path.name} is "
            f"{robot.links[0]}, which is not the first"
        )
    for name in names:
        check_name(name, robot.joints, f"{source}: {robot.path.name} has no joint", UsageError)
    positions = np.zeros((frames, len(robot.joints)))
    positions[:, [robot.joints.index(name) for name in names]] = joints
    return MotionClip(
        name=Path(source).stem,
        rate=rate,
        root_position=places[:, 0],
        root_orientation=normalize(turns[:, 0, [1, 2, 3, 0]]),
        joint_names=robot.joints,
        joint_positions=positions,
    )


def _split(text: Any) -> list[str]:
    parts = str(text).strip("[]").split(",")
    return [part.strip(" '\"") for part in parts if part.strip(" '\"")]
