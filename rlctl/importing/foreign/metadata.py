"""Metadata of ONNX files that mjlab and the exporters for Isaac Lab write: `joint_names`, `action_scale` and others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlctl.importing.foreign.draft import Draft
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.importing.foreign.unitree_lab import read_term
from rlctl.task.mujoco.robot import Robot

TITLE = "metadata of ONNX files of mjlab and Isaac Lab"
_NUMBERS = {
    "default_joint_pos": "default_positions",
    "joint_stiffness": "stiffness",
    "joint_damping": "damping",
    "action_scale": "action_scale",
}
_OBSERVATIONS = {"command": "velocity_commands", "twist": "velocity_commands"}  # names in mjlab, and in Isaac Lab


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
    names = _split(content["observation_names"])
    lengths = [int(length) for length in _split(content.get("observation_history_lengths", ""))] or [1] * len(names)
    values["observations"] = [
        read_term(_OBSERVATIONS.get(name, name), {"history_length": length}, source)
        for name, length in zip(names, lengths, strict=False)
    ]
    if "control_dt" in content:
        values["control_dt"] = float(content["control_dt"])
    draft.notes.append("observations: metadata have no scales; taken as 1")
    return draft


def _split(text: Any) -> list[str]:
    parts = str(text).strip("[]").split(",")
    return [part.strip(" '\"") for part in parts if part.strip(" '\"")]
