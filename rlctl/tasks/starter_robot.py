"""The robot of a starter plugin: a planar arm, or a user's own model, of which it reads joints, limits and a tip."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlctl.errors import TaskError, UsageError, check_name
from rlctl.tasks.asked_motors import AskedMotors
from rlctl.tasks.model_copy import copy_model, find_own_model
from rlctl.tasks.pybullet_probe import reads_in_pybullet
from rlctl.tasks.source_text import SourceText, join_source, write_comment, write_list, write_number, write_string

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody
    from rlctl.tasks.arms import ArmModel, Tip

_PLANAR_ARM = Path(__file__).with_name("arm.urdf")
_SUSPICIOUS = 3  # so many joints with the same number for effort and speed
_FASTEST = {"rotates": 3.0, "slides": 0.5}  # [rad/s], [m/s] of a first task; models often have no useful limit
_GUESSED_FORCE = 10.0  # [N m or N], of a joint without a limit
_FULL_TORQUE = 0.1  # [rad], from the target at which a motor of unknown gain gives its stall torque
_GUESSED_DAMPING, _GUESSED_ARMATURE = 0.03, 0.01  # [s], of the stiffness; [kg m^2]
_LOWEST_TIP = 0.03  # [m], above the floor, at the start
_IN_FLOOR = 1e-3  # [m]
_TRIES = 300
_GUESS = "a guess"  # where a start is from
_FLOOR = SourceText('        sim.load("floor", "plane.urdf", fixed=True)\n')


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
        "tip_point": SourceText("[]"),
        "joints": SourceText('["shoulder", "elbow"]'),
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
        "tip_to_goal": SourceText("(self.goal - self.find_tip())[:2]"),
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
        kept=frozenset({"origin", "drives"}),
    )


@dataclasses.dataclass(frozen=True)
class _Arm:
    body: MujocoBody
    path: Path
    model: ArmModel
    tip: Tip
    joints: list[str]  # that move the tip
    start: Any  # positions of all joints
    height: float  # [m], of the base above where the file has it
    origin: str  # of `start`: a keyframe, or a guess
    motors: AskedMotors | None


def read_robot(model: str, link: str | None, motors: AskedMotors | None = None) -> StarterRobot:
    """Read a user's URDF or MJCF file; `link`, or a site, is the tip, by default that of `ArmModel.find_tip`.

    It has real `motors`, or ideal ones.

    Raises `UsageError` for a file that is missing, cannot be loaded, has no joints, a free base or no such link.
    """
    from rlctl.task.mujoco.sim import MujocoSim
    from rlctl.tasks.arms import ArmModel

    sim, path = MujocoSim(control_dt=1 / 30, substeps=4), find_own_model(model)
    try:
        body = sim.load("arm", path, fixed=True)
    except TaskError as error:
        raise UsageError(f"--model: {error}") from None
    legs = "" if body.fixed else "; for a robot with legs add --walk"
    check_mounted(body, model, f"this makes a task for an arm that is mounted{legs}")
    arm = ArmModel(body)
    tip = _find_tip(arm, link)
    joints = [body.joint_names[joint] for joint in arm.list_joints_to(tip.link)]
    start, height, origin = _find_start(arm, tip)
    described = _Arm(body, path, arm, tip, joints, start, height, origin, motors)
    only_mujoco = motors is None and not reads_in_pybullet(path, body.joint_names)
    kept = {
        "point" if tip.point is not None else "origin": True,
        "mujoco": only_mujoco,
        "motors": motors is not None,
        "drives": motors is None,
    }
    return StarterRobot(
        _describe(described),
        copy_model(path),
        _summarize(described, only_mujoco=only_mujoco),
        kept=frozenset(name for name, is_kept in kept.items() if is_kept),
    )


def _find_tip(arm: ArmModel, asked: str | None) -> Tip:
    """Return the tip of an arm, or that link or site; raises `UsageError` if there is none, or if it does not move."""
    body, sites = arm.body, arm.list_sites()
    name = asked if asked is not None else arm.find_tip()
    links = [body.base_name, *body.link_names]
    check_name(name, [*links, *sites], f"--link: {body.file.name} has no link or site", UsageError)
    if name not in links:
        return sites[name]
    if not arm.list_joints_to(name):
        raise UsageError(f"--link {name!r}: no joint moves it; choose another of: {', '.join(body.link_names)}")
    return arm.choose_point(name)


def check_mounted(body: MujocoBody, model: str, advice: str) -> None:
    """Raise `UsageError`, which ends in `advice`, for a body with a free base or without joints."""
    if not body.fixed:
        raise UsageError(f"--model {model}: its base is free; {advice}")
    if not body.joint_names:
        raise UsageError(f"--model {model}: it has no joints; {advice}")


def _summarize(arm: _Arm, *, only_mujoco: bool) -> str:
    """Return what was chosen, a sentence a line."""
    names = arm.body.joint_names
    others = [name for name in names if name not in arm.joints]
    lines = [f"{', '.join(arm.joints)} of {arm.path.name} bring {arm.tip} to a goal"]
    still = [name for name in arm.joints if not arm.model.moves(arm.tip, [names.index(name)])]
    if still:
        lines.append(f"{', '.join(still)} cannot move it, and could be left out of JOINTS")
    if others:
        lines.append(f"START of {', '.join(others)} is kept")
    lines.append(f"START is {arm.origin}")
    if unused := _list_unused(arm.path):
        lines.append(
            f"Not used of the file: {', '.join(unused)}; the task's act() drives the joints by drive_to. "
            "set_controls would use its actuators"
        )
    if arm.height:
        lines.append(f"It is {arm.height:g} m above the floor, into which it hangs otherwise")
    if only_mujoco:
        lines.append("PyBullet does not read this file as MuJoCo does, so the recipe has sim: mujoco")
    lines += list_faults(arm.body)
    lines.append("--link chooses another link; comments with CHANGE in task.py mark what to adapt")
    return ".\n".join(lines)


def _list_unused(path: Path) -> list[str]:
    """Return what a starter does not use of an MJCF file and users expect."""
    import mujoco

    if path.suffix != ".xml":
        return []
    spec = mujoco.MjSpec.from_file(str(path))
    found = {
        "actuators": bool(spec.actuators),
        "<option>": b"<option" in path.read_bytes(),
        "<exclude> and <pair>": bool(spec.excludes or spec.pairs),
    }
    return [name for name, is_there in found.items() if is_there]


def list_faults(body: MujocoBody) -> list[str]:
    """Return what is wrong with a model's file, without a full stop; `rlctl check-env` finds it, too."""
    from rlctl.task.model_faults import find_model_faults

    faults = [fault.rstrip(".") for fault in find_model_faults(body)]
    forces, speeds = body.joint_max_force, body.joint_max_speed
    if len(forces) >= _SUSPICIOUS and len({*forces}) == 1 and len({*speeds}) == 1 and forces[0] == speeds[0] > 0:
        faults.append(
            f"All joints have an effort and a velocity of {forces[0]:g}: these may be placeholders; see the data sheet"
        )
    return faults


def _describe(arm: _Arm) -> dict[str, str]:
    body, path, start = arm.body, arm.path, arm.start
    body.set_joints(start)
    place = arm.model.locate(arm.tip)
    place[2] += arm.height
    reach, farthest = arm.model.measure_reach(arm.tip)
    tolerance = max(0.002, float(f"{0.05 * reach:.1g}"))
    speeds, speed_comment = _limit_speeds(body)
    forces, force_comment = _limit_forces(body)
    chosen = body.find_joints(arm.joints)
    is_bounded = all(math.isfinite(limit) for limit in [*body.joint_low[chosen], *body.joint_high[chosen]])
    point = arm.tip.point if arm.tip.point is not None else ()
    return {
        "robot": name_robot(path),
        "robot_phrase": name_robot(path),
        "model": path.name,
        "floor": SourceText() if arm.model.has_plane() else _FLOOR,
        "fixed": _write_pose(arm),
        "tip": arm.tip.link,
        "tip_point": SourceText(f"[{join_source(map(write_number, point))}]"),
        "joints": write_list("JOINTS = ", map(write_string, arm.joints)),
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
        "tip_to_goal": SourceText("self.goal - self.find_tip()"),
        "axes": "",
        "clips_target": str(is_bounded),
        "pose": write_list("    task.arm.set_joints(np.array(", map(write_number, start), "))"),
        "pose_comment": "START, and where MuJoCo placed the tip when this plugin was written: has the model changed?",
        "pose_tip": SourceText(f"[{join_source(write_number(value, '.4f') for value in place)}]"),
        "reach": write_number(math.ceil(100 * (farthest + arm.height)) / 100, "g"),
        "total_timesteps": "200_000",
        "every_steps": "40_000",
        **_describe_motors(arm),
    }


def _describe_motors(arm: _Arm) -> dict[str, str]:
    """Return texts of the real motors that were asked for; values that their table does not have are guesses."""
    if arm.motors is None:
        return {}
    stiffness = (arm.motors.motor.stall_torque_nm or _GUESSED_FORCE) / _FULL_TORQUE
    guesses = {
        "stiffness_nm_per_rad": float(f"{stiffness:.2g}"),
        "damping_nms_per_rad": float(f"{_GUESSED_DAMPING * stiffness:.2g}"),
        "armature_kgm2": _GUESSED_ARMATURE,
    }
    return arm.motors.write(guesses, "arm")


def _write_pose(arm: _Arm) -> SourceText:
    """Return the arguments of `Sim.load` that say where the base is; only URDF files do not contain it."""
    position = f", position=(0.0, 0.0, {write_number(arm.height, 'g')})" if arm.height else ""
    fixed = ", fixed=True" if arm.path.suffix == ".urdf" else ""
    return SourceText(position + fixed)


def name_robot(model: Path) -> str:
    """Return the name of a model's file as text; what is no text of it becomes question marks."""
    return model.stem.encode(errors="replace").decode()


def _find_start(arm: ArmModel, tip: Tip) -> tuple[Any, float, str]:
    """Return joint positions inside their limits, how far the base must be raised [m], and where they are from.

    They are those of an MJCF file's keyframe, or near 0, or else any: the tip is above the floor, and no link that
    moves is in it. If there are no such positions the base is raised by how far down the robot gets.
    """
    import numpy as np

    low, high = arm.find_range()
    rng = np.random.default_rng(0)
    keyed, origin = _read_keyframe(arm.body)
    poses = [*keyed, np.clip(0.0, low, high), (low + high) / 2, *(rng.uniform(low, high) for _ in range(_TRIES))]
    shapes, has_plane, lowest = arm.list_moving_shapes(), arm.has_plane(), 0.0
    for number, pose in enumerate(poses):
        pose = np.round(pose, 3) + 0.0  # no -0.0
        arm.body.set_joints(pose)
        tip_height, lowest_shape = float(arm.locate(tip)[2]), arm.find_lowest(shapes)
        if tip_height > _LOWEST_TIP and (has_plane or lowest_shape > -_IN_FLOOR):
            is_other = number >= len(keyed) > 0
            return pose, 0.0, _GUESS if is_other else origin
        lowest = min(lowest, tip_height, lowest_shape)
    if has_plane:
        raise UsageError(f"{arm.body.file.name}: {tip.link!r} is never above the floor, z = 0; choose another --link")
    return np.round(poses[0], 3) + 0.0, math.ceil(100 * (_LOWEST_TIP - lowest)) / 100, origin


def _read_keyframe(body: MujocoBody) -> tuple[list[Any], str]:
    """Return the joint positions of an MJCF file's keyframe and its name, for people.

    Without usable ones the list is empty, and the text says why if they are outside the limits.
    """
    import numpy as np

    from rlctl.task.mujoco.robot import read_keyframe

    name, keyed = read_keyframe(body.file, body.joint_names)
    limits = zip(body.joint_names, body.joint_low, body.joint_high, strict=True)
    outside = [joint for joint, low, high in limits if joint in keyed and not low <= keyed[joint] <= high]
    if outside:
        first = f"{outside[0]} at {keyed[outside[0]]:g}"
        fault = f"the keyframe {name!r} has {first}, outside its limits (a keyframe is in radians)"
        return [], f"{_GUESS}: {fault}"
    if not set(body.joint_names) <= set(keyed):
        return [], _GUESS
    return [np.array([keyed[joint] for joint in body.joint_names])], f"the keyframe {name!r} of the file"


def _limit_speeds(body: MujocoBody) -> tuple[list[float], str]:
    kinds = ["slides" if kind == 2 else "rotates" for kind in body._sim.model.jnt_type[body.parts.joints].tolist()]
    limits = [limit or math.inf for limit in body.joint_max_speed.tolist()]
    speeds = [min(_FASTEST[kind], limit) for kind, limit in zip(kinds, limits, strict=True)]
    return (
        speeds,
        ", as in the model" if speeds == limits else "; CHANGE: those of your motors, below the model's limits",
    )


def _limit_forces(body: MujocoBody) -> tuple[list[float], str]:
    limits = [limit if math.isfinite(limit) else 0.0 for limit in body.joint_max_force.tolist()]
    if all(limits):
        return limits, ", as in the model; CHANGE: those of your motors"
    return [limit or _GUESSED_FORCE for limit in limits], "; CHANGE: a guess where the model has no limit"
