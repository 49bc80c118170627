"""The robot of a starter plugin: a planar arm, or a user's own model, of which it reads joints, limits and a tip."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.tasks.model_copy import copy_model, find_own_model
from rlctl.tasks.source_text import Source, join_source, write_comment, write_list, write_number, write_string

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

_PLANAR_ARM = Path(__file__).with_name("arm.urdf")
_FASTEST = {"rotates": 3.0, "slides": 0.5}  # [rad/s], [m/s] of a first task; models often have no useful limit
_GUESSED_FORCE = 10.0  # [N m or N], of a joint without a limit
_LOWEST_TIP = 0.03  # [m], above the floor, at the start
_TRIES = 300
_FLOOR = Source('        sim.load("floor", "plane.urdf", fixed=True)\n')


@dataclasses.dataclass(frozen=True)
class StarterRobot:
    """What a starter plugin contains of a robot."""

    values: Mapping[str, str]
    """Texts for the placeholders of the templates."""
    files: Mapping[Path, bytes]
    """The model and its meshes, relative to the package."""
    summary: str
    """What was chosen, a line or several."""
    template: Path | None = None
    """Folder with files that replace those of an arm."""
    kept: frozenset[str] = frozenset()
    """Names of the templates' optional lines that the plugin has."""


def make_planar_arm() -> StarterRobot:
    """Return the arm of two joints that a plugin has without a model of the user."""
    values = {
        "robot": "planar arm",
        "robot_phrase": "a planar arm of two joints",
        "model": "arm.urdf",
        "floor": _FLOOR,
        "fixed": ", fixed=True",
        "tip": "tip",
        "joints": Source('["shoulder", "elbow"]'),
        "all_joints": "# Of all joints of the model, in its order.",
        "start": "[0.0, 1.2]",
        "start_comment": ", elbow bent",
        "max_speed": "[3.0, 3.0]",
        "speed_comment": ", as in the model",
        "max_force": "[10.0, 10.0]",
        "force_comment": ", as in the model",
        "start_noise": "0.3",
        "tolerance": "0.04",
        "smaller": "0.02",
        "goal_range": "0.8",
        "episode_s": "1.5",
        "distance_weight": "-1.0",
        # The arm moves in a plane: the third element would never change.
        "tip_to_goal": "(self.goal - self.arm.link_position(TIP))[:2]",
        "axes": "[:2]",
        "clips_target": "True",
        "pose": "[0.0, 0.0]",
        "pose_comment": "Two links of 0.3 m along x, 0.05 m above the floor.",
        "pose_tip": "[0.6, 0.0, 0.05]",
        "reach": "0.65",
        "total_timesteps": "60_000",
        "every_steps": "20_000",
    }
    arm = Path("arm.urdf"), _PLANAR_ARM.read_bytes()
    return StarterRobot(
        values,
        dict([arm]),
        "A planar arm moves its tip to a goal. Comments with CHANGE in task.py mark what to replace",
    )


def read_robot(model: str, link: str | None) -> StarterRobot:
    """Read a user's URDF or MJCF file; `link` is the tip, by default `_find_tip`.

    Raises `UsageError` for a file that is missing, cannot be loaded, has no joints, a free base or no such link.
    """
    from rlctl.task.mujoco.sim import MujocoSim

    sim, path = MujocoSim(control_dt=1 / 30, substeps=4), find_own_model(model)
    try:
        body = sim.load("arm", path, fixed=True)
    except TaskError as error:
        raise UsageError(f"--model: {error}") from None
    if not body.fixed or not body.joint_names:
        what = "its base is free" if not body.fixed else "it has no joints"
        legs = "" if body.fixed else "; for a robot with legs add --walk"
        raise UsageError(f"--model {model}: {what}; this makes a task for an arm that is mounted{legs}")
    tip = link if link is not None else _find_tip(body)
    check_name(tip, [body.base_name, *body.link_names], f"--link: {path.name} has no link", UsageError)
    joints = [body.joint_names[joint] for joint in _list_joints_to(body, tip)]
    if not joints:
        raise UsageError(f"--link {tip!r}: no joint moves it; choose another of: {', '.join(body.link_names)}")
    others = [name for name in body.joint_names if name not in joints]
    held = f" START of {', '.join(others)} is kept." if others else ""
    return StarterRobot(
        _describe(body, path, tip, joints),
        copy_model(path),
        f"{', '.join(joints)} of {path.name} bring {tip!r} to a goal.{held} --link chooses another link; "
        "comments with CHANGE in task.py mark what to adapt",
    )


def _list_parents(body: MujocoBody, link: str) -> list[int]:
    """Return the numbers of MuJoCo's bodies from a link to the base."""
    parents, number = body._sim.model.body_parentid, body.find_link(link)
    numbers = [number]
    while number and number != body.find_link(body.base_name):
        number = int(parents[number])
        numbers.append(number)
    return numbers


def _list_joints_to(body: MujocoBody, link: str) -> list[int]:
    """Return the indices of the joints that move a link."""
    chain = set(_list_parents(body, link))
    owners = body._sim.model.jnt_bodyid[body.parts.joints].tolist()
    return [index for index, owner in enumerate(owners) if owner in chain]


def _find_tip(body: MujocoBody) -> str:
    """Return the link at the end of the longest chain; a frame without shapes, which marks a tool, goes first."""
    model = body._sim.model
    moved = [link for link in body.link_names if _list_joints_to(body, link)]
    parents = {int(model.body_parentid[body.find_link(link)]) for link in moved}
    ends = [link for link in moved if body.find_link(link) not in parents]
    frames = [link for link in ends if model.body_geomnum[body.find_link(link)] == 0]
    return max(frames or ends or moved, key=lambda link: len(_list_joints_to(body, link)))


def _describe(body: MujocoBody, path: Path, tip: str, joints: list[str]) -> dict[str, str]:
    start, model = _find_start(body, tip), body._sim.model
    body.set_joints(start)
    place = body.link_position(tip)
    reach = sum(math.dist(model.body_pos[number], (0, 0, 0)) for number in _list_parents(body, tip)[:-1])
    reach += sum(abs(model.jnt_range[joint]).max() for joint in body.parts.joints if model.jnt_type[joint] == 2)
    tolerance = max(0.002, float(f"{0.05 * reach:.1g}"))
    speeds, speed_comment = _limit_speeds(body)
    forces, force_comment = _limit_forces(body)
    chosen = body.find_joints(joints)
    is_bounded = all(math.isfinite(limit) for limit in [*body.joint_low[chosen], *body.joint_high[chosen]])
    return {
        "robot": name_robot(path),
        "robot_phrase": name_robot(path),
        "model": path.name,
        "floor": "" if _has_plane(body) else _FLOOR,
        "fixed": ", fixed=True" if path.suffix == ".urdf" else "",  # other formats contain it
        "tip": tip,
        "joints": write_list("JOINTS = ", map(write_string, joints)),
        "all_joints": write_comment(f"Of all joints of the model: {', '.join(body.joint_names)}."),
        "start": write_list("START = np.array(", map(write_number, start)),
        "start_comment": "; CHANGE: a pose from which the arm gets everywhere",
        "max_speed": write_list("MAX_SPEED = ", map(write_number, speeds)),
        "speed_comment": speed_comment,
        "max_force": write_list("MAX_FORCE = ", map(write_number, forces)),
        "force_comment": force_comment,
        "start_noise": "0.1",
        "tolerance": write_number(tolerance, "g"),
        "smaller": write_number(tolerance / 2, "g"),
        "goal_range": "0.8",
        "episode_s": "3.0",
        "distance_weight": write_number(-1 / reach, ".2g"),
        "tip_to_goal": "self.goal - self.arm.link_position(TIP)",
        "axes": "",
        "clips_target": str(is_bounded),
        "pose": write_list("    task.arm.set_joints(np.array(", map(write_number, start), "))"),
        "pose_comment": "START, and where MuJoCo placed the tip when this plugin was written: has the model changed?",
        "pose_tip": Source(f"[{join_source(write_number(value, '.4f') for value in place)}]"),
        "reach": write_number(math.ceil(100 * reach) / 100, "g"),
        "total_timesteps": "200_000",
        "every_steps": "40_000",
    }


def name_robot(model: Path) -> str:
    """Return the name of a model's file as text; what is no text of it becomes question marks."""
    return model.stem.encode(errors="replace").decode()


def _has_plane(body: MujocoBody) -> bool:
    """Return whether the model, which is all of the world, has a floor of its own."""
    import mujoco

    return int(mujoco.mjtGeom.mjGEOM_PLANE) in body._sim.model.geom_type.tolist()


def _find_start(body: MujocoBody, tip: str) -> Any:
    """Return joint positions inside their limits in which the tip is above the floor, near 0 if possible."""
    import numpy as np

    low, high = body.joint_low, body.joint_high
    inner_low, inner_high = np.where(np.isfinite(low), 0.9 * low + 0.1 * high, -1), 0.1 * low + 0.9 * high
    inner_high = np.where(np.isfinite(high), inner_high, 1)
    rng = np.random.default_rng(0)
    poses = [np.clip(0.0, inner_low, inner_high), (inner_low + inner_high) / 2]
    poses += [rng.uniform(inner_low, inner_high) for _ in range(_TRIES)]
    for pose in poses:
        pose = np.round(pose, 3) + 0.0  # no -0.0
        body.set_joints(pose)
        if body.link_position(tip)[2] > _LOWEST_TIP:
            return pose
    raise UsageError(f"{body.file.name}: {tip!r} is never above the floor, z = 0; choose another --link")


def _limit_speeds(body: MujocoBody) -> tuple[list[float], str]:
    kinds = ["slides" if kind == 2 else "rotates" for kind in body._sim.model.jnt_type[body.parts.joints].tolist()]
    limits = [limit or math.inf for limit in body.joint_max_speed.tolist()]
    speeds = [min(_FASTEST[kind], limit) for kind, limit in zip(kinds, limits, strict=True)]
    return (
        speeds,
        ", as in the model" if speeds == limits else "; CHANGE: those of your motors, below the model's limits",
    )


def _limit_forces(body: MujocoBody) -> tuple[list[float], str]:
    limits = body.joint_max_force.tolist()
    if all(limits):
        return limits, ", as in the model; CHANGE: those of your motors"
    return [limit or _GUESSED_FORCE for limit in limits], "; CHANGE: a guess where the model has no limit"
