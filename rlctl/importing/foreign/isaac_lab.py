"""IO descriptors of Isaac Lab, which its training writes with `--export_io_descriptors`; and LEAPP, which is refused.

All values are in Isaac Lab's order of joints, whose names the file has. Joints of explicit actuators, such as a
`DCMotor`, have a stiffness and damping of 0 there: theirs are not in the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rlctl.errors import UsageError
from rlctl.importing.foreign.draft import Draft
from rlctl.importing.foreign.network import ForeignNetwork
from rlctl.importing.foreign.unitree_lab import read_term, shorten
from rlctl.task.mujoco.robot import Robot

TITLE = "IO descriptors of Isaac Lab"
_ACTION = "joint_position_action"
_GROUP = "policy"  # of the observations that the policy gets
_GAINS = {"default_joint_stiffness": "stiffness", "default_joint_damping": "damping"}
_VELOCITIES = 3  # numbers of a velocity command
_OF_LEAPP = ("models", "pipeline", "system information")


def matches(content: Mapping[str, Any]) -> bool:
    """Return whether a file has this form."""
    return "articulations" in content and "actions" in content and "observations" in content


def read(content: Mapping[str, Any], source: str, robot: Robot, network: ForeignNetwork) -> Draft:
    """Return what the file says; raises `UsageError` for what rlctl does not know."""
    names = [str(action.get("name")) for action in content["actions"]]
    if names != [_ACTION]:
        raise UsageError(f"{source}: actions are {', '.join(names) or 'missing'}; only {_ACTION} is imported")
    (action,) = content["actions"]
    joints = list(action["joint_names"])
    draft = Draft(source, {"joints": joints, "action_scale": action.get("scale")})
    values = draft.values
    values["default_positions"] = np.broadcast_to(np.asarray(action["offset"], float), len(joints)).tolist()
    if action.get("clip") is not None:
        draft.notes.append("actions: the clip of joint targets is left out")
    _read_articulation(content["articulations"], joints, draft)
    scene = content.get("scene") or {}
    for name, key in (("control_dt", "dt"), ("physics_dt", "physics_dt")):
        if key in scene:
            values[name] = scene[key]
    groups = content["observations"]
    terms = groups[_GROUP] if _GROUP in groups else next(iter(groups.values()))
    values["observations"] = [_read_observation(term, values, source) for term in terms]
    return draft


def _read_articulation(articulations: Mapping[str, Any], joints: Sequence[str], draft: Draft) -> None:
    robots = [one for one in articulations.values() if set(joints) <= set(one["joint_names"])]
    if len(robots) != 1:
        raise UsageError(f"{draft.source}: {len(robots)} articulations have the joints of the action, expected one")
    (robot,) = robots
    order = [list(robot["joint_names"]).index(name) for name in joints]
    for key, name in _GAINS.items():
        gains = [robot[key][index] for index in order] if key in robot else []
        if any(gains):
            draft.values[name] = gains
    if "stiffness" not in draft.values:
        draft.notes.append("stiffness: the file has none, as of all explicit actuators of Isaac Lab")
    armature = [robot["default_joint_armature"][index] for index in order] if "default_joint_armature" in robot else []
    if any(armature):
        draft.values["armature"] = armature


def _read_observation(term: Mapping[str, Any], values: Mapping[str, Any], source: str) -> dict[str, Any]:
    name = str(term["name"])
    part = read_term(name, dict(term.get("overloads") or {}), source)
    shape = term.get("shape") or [_VELOCITIES]
    if part["kind"] == "command" and shape != [_VELOCITIES]:
        raise UsageError(
            f"{source}: {name} has {shape[-1]} numbers, and a velocity command 3; policies that reach a goal are not "
            "imported"
        )
    if "joint_names" in term and list(term["joint_names"]) != values["joints"]:
        raise UsageError(f"{source}: {name} observes other joints than the action moves, which rlctl does not import")
    offsets = term.get("joint_pos_offsets")
    if offsets is not None and not np.allclose(offsets, values["default_positions"]):
        raise UsageError(f"{source}: joint_pos_offsets are not the action's offset, which rlctl does not import")
    if "scale" in part:
        part["scale"] = shorten(part["scale"])
    return part


def refuse_leapp(content: Mapping[str, Any], source: str) -> None:
    """Raise `UsageError` for a description of LEAPP: its graph is more than a network."""
    if all(key in content for key in _OF_LEAPP):
        raise UsageError(
            f"{source}: LEAPP, whose graph computes observations and joint targets itself, is not imported\n"
            "give the policy.onnx that Isaac Lab's play.py exports, and --deploy IO_descriptors.yaml, which its "
            "train.py writes with --export_io_descriptors"
        )
