"""The legged robot of a starter plugin that walks: stance, gains and commands from a user's model."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rlctl.errors import TaskError, UsageError
from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion import MotionClip
from rlctl.task.mujoco.robot import read_keyframe
from rlctl.task.rotations import rotate_inverse
from rlctl.tasks.asked_motors import AskedMotors
from rlctl.tasks.clips import list_files, read_clips, write_clips
from rlctl.tasks.gait import Gait, describe_gait
from rlctl.tasks.legs import Leg, Skeleton, find_legs, find_wheels
from rlctl.tasks.model_copy import copy_model, find_own_model, remove_floor
from rlctl.tasks.scaling import GRAVITY, ScaledRobot, scale
from rlctl.tasks.source_text import SourceText, join_source, write_comment, write_list, write_number, write_string
from rlctl.tasks.stance import Stance, StanceSearch, measure_stance
from rlctl.tasks.starter_robot import StarterRobot, list_faults, name_robot

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

TEMPLATE = Path(__file__).with_name("template_walk")
"""Templates of the files that differ from those of an arm."""
_CONTROL_DT = 0.02  # [s]
_STEPS = 100  # that it must stand with zero actions
_TINY = 1e-3  # [rad], of rounding
_ENDLESS_FORCE = 20.0  # of weight x leg length
_WEAK = 0.15  # of weight x leg length
_DENSEST, _LIGHTEST = 22_600.0, 1.2  # [kg/m^3], of osmium and of air
_MOST_NAMES = 4
_LEVEL = 0.03  # of the leg length: how much the feet's heights may differ
_KEYED = (0.55, 0.97)  # of the longest leg: legs of a keyframe that is a stance
_UPRIGHT = -0.9  # component z of the direction of gravity, in the trunk's frame


@dataclasses.dataclass(frozen=True)
class _Legged:
    body: MujocoBody
    path: Path
    legs: list[Leg]
    stance: Stance
    keyframe: str  # from which the stance is; empty if it was searched
    steps_up: int  # for which it stands with zero actions, at most `_STEPS`
    height: float  # of the trunk's centre of mass above the ground when it stands [m]
    gait: Gait
    motors: AskedMotors | None
    clips: Sequence[MotionClip]  # whose style it walks in; empty for its own

    @property
    def guesses(self) -> dict[str, float]:
        """Values of a real motor that the table of motors may not have."""
        numbers = self.scaled
        return {
            "stiffness_nm_per_rad": numbers.stiffness,
            "damping_nms_per_rad": numbers.damping,
            "armature_kgm2": numbers.armature,
        }

    @property
    def scaled(self) -> ScaledRobot:
        return scale(self.body.total_mass(), self.stance, len(self.legs))

    @property
    def is_biped(self) -> bool:
        return len(self.legs) == 2

    @property
    def joints(self) -> list[int]:
        return sorted(joint for leg in self.legs for joint in leg.joints)

    @property
    def feet(self) -> list[str]:
        return [leg.foot.link for leg in self.legs]


def read_legged_robot(
    model: str,
    motors: AskedMotors | None = None,
    motions: Sequence[str] = (),
    options: ClipOptions = ClipOptions(),  # noqa: B008 (it cannot change)
) -> StarterRobot:
    """Read a user's URDF or MJCF file of a robot with legs, which is free to move, with real `motors` or springs.

    It walks in the style of the clips `motions`, if there are any.

    Raises `UsageError` for a file that is missing, cannot be loaded, has no joints, a fixed base or no legs.
    """
    path, body = load_free(model, "--walk")
    if not body.joint_names:
        raise UsageError(f"--model {model}: it has no joints; --walk makes a task for a robot with legs")
    if body.fixed:
        raise UsageError(f"--model {model}: its base is fixed; add <freejoint/> to the body {body.base_name!r}")
    skeleton = Skeleton(body)
    if wheels := find_wheels(skeleton):
        raise UsageError(
            f"--model {model}: it stands on wheels ({', '.join(wheels)}), and --walk is for legs; "
            "write a task for them as docs/task.md describes, beginning with: rlctl tasks new NAME"
        )
    legs, mirror = find_legs(skeleton)
    if slides := [body.joint_names[joint] for leg in legs for joint in leg.joints if _slides(body, joint)]:
        raise UsageError(f"--model {model}: joint {slides[0]!r} slides; --walk needs legs whose joints rotate")
    search = StanceSearch(skeleton, legs, mirror)
    keyframe, stance = _find_keyframe(skeleton, legs, search.longest)
    stance = stance or search.find()
    gait = describe_gait(skeleton, legs, stance, mirror)
    clips, found = read_clips(body, motions, options)
    legged = _Legged(body, path, legs, stance, keyframe, 0, stance.height, gait, motors, clips)
    steps_up, height = _stand(legged)
    legged = dataclasses.replace(legged, steps_up=steps_up, height=height)
    files = copy_model(path) | write_clips(clips)
    notes = [*found, *_list_notes(legged), *remove_floor(files, Path(path.name))]
    return StarterRobot(
        _describe(legged), files, _summarize(legged, notes), template=TEMPLATE, kept=_choose_lines(legged)
    )


def _choose_lines(legged: _Legged) -> frozenset[str]:
    """Return which optional lines of the template the plugin has: those of a clock, and of a mirror image."""
    kind, is_mirrored = "clock" if legged.is_biped else "walk", bool(legged.gait.other_side)
    has_motors = legged.motors is not None
    chosen = {
        kind: True,
        "aside": legged.is_biped and bool(legged.gait.aside),
        "motors": has_motors,
        "drives": not has_motors,
        "mirror": is_mirrored,
        f"mirror_{kind}": is_mirrored,
        "mirror_motors": is_mirrored and has_motors and legged.is_biped,  # whose critic sees what was drawn
        "style": bool(legged.clips),
        f"style_{kind}": bool(legged.clips),
    }
    return frozenset(name for name, is_kept in chosen.items() if is_kept)


def _count_steps(legged: _Legged) -> int:
    """Return the steps of the training."""
    if legged.motors is not None:
        return 6_000_000  # whose ranges grow: an A1 succeeds in 82 % after 3 million, in 98 % after 6
    return 4_000_000 if legged.is_biped else 3_000_000


def load_free(model: str, option: str) -> tuple[Path, MujocoBody]:
    """Load a model with a free base and joints; raises `UsageError`, which names the option that needs one."""
    from rlctl.task.mujoco.sim import MujocoSim

    path = find_own_model(model)
    try:
        return path, MujocoSim(control_dt=_CONTROL_DT, substeps=4).load("robot", path)
    except TaskError as error:
        problem = str(error)
    with contextlib.suppress(TaskError):
        base = MujocoSim(control_dt=_CONTROL_DT, substeps=4).load("robot", path, fixed=True).base_name
        problem = f"the base {base!r} of {path.name} cannot be free without mass; for an arm leave out {option}"
    raise UsageError(f"--model: {problem}")


def _slides(body: MujocoBody, joint: int) -> bool:
    return int(body._sim.model.jnt_type[body.parts.joints[joint]]) == 2


def _find_keyframe(skeleton: Skeleton, legs: Sequence[Leg], longest: float) -> tuple[str, Stance | None]:
    """Return the keyframe `home` of an MJCF file, or its first, if it is a stance for legs of `longest` [m]."""
    body = skeleton.body
    name, pose = read_keyframe(body.file, body.joint_names)
    if not set(body.joint_names) <= set(pose):
        return "", None
    positions = np.array([pose[joint] for joint in body.joint_names])
    stance = measure_stance(skeleton, legs, positions)
    low, high = (factor * longest for factor in _KEYED)
    inside = (positions >= body.joint_low - _TINY) & (positions <= body.joint_high + _TINY)
    if inside.all() and low <= stance.leg_length <= high and stance.unevenness <= _LEVEL * longest:
        return name, stance
    return "", None


def _stand(legged: _Legged) -> tuple[int, float]:
    """Return how many steps the robot stands with zero actions, at most `_STEPS`, and how high its trunk then is [m].

    The joints, which are springs, give way a little. The height of a robot that falls is that of its stance.
    """
    from rlctl.task.mujoco.sim import MujocoSim

    # As the task simulates it.
    sim = MujocoSim(control_dt=_CONTROL_DT, substeps=4, iterations=6, worlds=1)
    sim.load("ground", "plane.urdf", fixed=True).set_friction(0.8)
    body, numbers = sim.load("robot", legged.path), legged.scaled
    body.set_friction(1.0)
    forces: list[float] | None = None
    if legged.motors is not None:
        body.set_motors(legged.motors.complete(legged.guesses))
    else:
        body.set_drives(numbers.stiffness, numbers.damping, armature=numbers.armature)
        body.set_joint_damping(numbers.gear_damping)
        forces, _ = _limit_forces(legged)
    sim.save()
    stance, world = legged.stance.positions[None], np.zeros(1, np.int64)
    body.set_base(np.array([[0.0, 0.0, numbers.start_height]]), worlds=world)
    body.set_joints(stance, worlds=world)
    for step in range(_STEPS):
        body.drive_to(stance, max_force=forces)
        sim.step()
        down, height = rotate_inverse(body.base_orientation[0], (0.0, 0.0, -1.0)), float(body.base_position[0, 2])
        if down[2] > _UPRIGHT or height < numbers.fallen_height:
            return step, legged.stance.height
    return _STEPS, height


def _limit_forces(legged: _Legged) -> tuple[list[float], str]:
    limits, guess = legged.body.joint_max_force.tolist(), legged.scaled.stiffness
    if all(limits):
        return limits, ", as in the model; CHANGE: those of your motors"
    return [limit or guess for limit in limits], "; CHANGE: a guess where the model has no limit"


def _write_forces(forces: list[float]) -> SourceText:
    if len(set(forces)) == 1:
        return SourceText(f"[{write_number(forces[0])}] * {len(forces)}")
    return write_list("MAX_FORCE = ", map(write_number, forces))


def _list_notes(legged: _Legged) -> list[str]:
    """Return what a user should know, a sentence each."""
    stance, notes = legged.stance, []
    others = [name for index, name in enumerate(legged.body.joint_names) if index not in legged.joints]
    if others:
        notes.append(f"{', '.join(others)} {'keep' if len(others) > 1 else 'keeps'} STANCE")
    if legged.gait.faces_y:
        notes.append("Its legs are in pairs along x, so it may face along y; the commanded lin_vel_x is along x")
    if legged.gait.asymmetry and not legged.gait.other_side:
        notes.append(
            f"Its sides are no mirror images: with mirrored torques they accelerate up to {legged.gait.asymmetry:.0%} "
            "differently, because of masses or inertias. So the plugin has no mirror"
        )
    if stance.unevenness > _LEVEL * stance.leg_length:
        notes.append(
            f"Found no stance with level feet: their heights differ by {stance.unevenness:.2g} m; write your own STANCE"
        )
    limits = legged.body.joint_max_force
    notes += list_faults(legged.body)
    notes += _judge_torques(legged)
    notes += _judge_densities(legged.body)
    is_useless = not all(limits) or min(limits) > _ENDLESS_FORCE * legged.scaled.stiffness
    if is_useless and legged.motors is None:
        notes.append("The file has no useful torque limits for all joints: write those of your motors into MAX_FORCE")
    # Two legs that are springs hold no robot for long.
    if legged.steps_up < (_STEPS // 4 if legged.is_biped else _STEPS):
        notes.append(
            f"With zero actions it falls after {legged.steps_up * _CONTROL_DT:.1f} s: look at it with the first "
            "command below, and change STANCE, STIFFNESS or MAX_FORCE"
        )
    if legged.is_biped:
        notes.append("It steps in time with a clock, which PERIOD and SWING describe")
    return notes


def _judge_torques(legged: _Legged) -> list[str]:
    """Return a sentence if the strongest joint of the legs cannot hold the robot up."""
    advice = "Correct MAX_FORCE"
    largest = max(legged.body.joint_max_force[joint] for joint in legged.joints)
    if legged.motors is not None:
        advice = f"{legged.motors.name} is too weak for it"
        largest = legged.motors.motor.stall_torque_nm or 0.0
    needed = legged.body.total_mass() * GRAVITY * legged.stance.leg_length
    if not 0 < largest < _WEAK * needed:
        return []
    return [
        f"The largest torque limit of its legs, {largest:.3g} N m, is {100 * largest / needed:.2g} % of weight x leg "
        f"length, {needed:.3g} N m: walking robots have more than {100 * _WEAK:g} %. {advice}"
    ]


def _judge_densities(body: MujocoBody) -> list[str]:
    """Return a sentence for links that are denser than any metal, and for a robot that is lighter than air."""
    model, dense, volume = body._sim.model, [], 0.0
    solids = [geom for geom in body.parts.geoms if model.geom_type[geom] != 0]  # no planes: a file may have a floor
    for number, link in body.parts.link_names.items():
        geoms = [geom for geom in solids if int(model.geom_bodyid[geom]) == number]
        box = float(sum(8 * np.prod(model.geom_aabb[geom, 3:]) for geom in geoms))  # [m^3], at least that of the link
        mass = float(model.body_mass[number])
        volume += box
        if geoms and box > 0 and mass / box > _DENSEST:
            dense.append(f"{link} {mass:.3g} kg in {1e6 * box:.3g} cm^3")
    notes = []
    if dense:
        more = f" and {len(dense) - _MOST_NAMES} more" if len(dense) > _MOST_NAMES else ""
        notes.append(f"Links denser than any metal: {', '.join(dense[:_MOST_NAMES])}{more}. Correct masses or lengths")
    if volume > 0 and body.total_mass() / volume < _LIGHTEST:
        notes.append(
            f"It weighs {body.total_mass():.3g} kg in {volume:.3g} m^3, less than air. Correct masses or lengths"
        )
    return notes


def _summarize(legged: _Legged, notes: Sequence[str]) -> str:
    start = f"keyframe {legged.keyframe!r}" if legged.keyframe else "a search"
    if legged.clips:
        start += f"; walks in the style of {', '.join(clip.name for clip in legged.clips)}"
    first = (
        f"{legged.path.name}: {legged.body.total_mass():.3g} kg on {len(legged.legs)} legs, "
        f"{', '.join(legged.feet)}; {legged.stance.leg_length:.2g} m from hip to foot in STANCE, which is from {start}"
    )
    return ".\n".join([first, *notes, "Comments with CHANGE in task.py mark what to adapt"])


def _list_all_joints(legged: _Legged) -> SourceText:
    names = legged.body.joint_names
    if len(legged.joints) == len(names):
        return write_comment("Of all joints of the model, in its order.")
    return write_comment(f"Of all joints of the model: {', '.join(names)}.")


def _describe(legged: _Legged) -> dict[str, str]:
    body, stance, numbers = legged.body, legged.stance, legged.scaled
    name = name_robot(legged.path)
    forces, force_comment = _limit_forces(legged)
    found = f", keyframe {legged.keyframe!r} of the file" if legged.keyframe else ", knees bent"
    steps, steps_comment = max(1, legged.steps_up // 2), SourceText()
    if steps != _STEPS // 2:
        steps_comment = SourceText("  # CHANGE: it fell later when this plugin was written")
    return {
        "robot": name,
        "robot_phrase": name,
        "model": legged.path.name,
        "joints": write_list("JOINTS = ", [write_string(body.joint_names[joint]) for joint in legged.joints]),
        "all_joints": _list_all_joints(legged),
        "stance": write_list("STANCE = np.array(", map(write_number, stance.positions), ")"),
        "stance_comment": f"{found}; CHANGE: a pose in which it stands well",
        "height": write_number(legged.height, ".3f"),
        "fallen_height": write_number(numbers.fallen_height, ".3f"),
        "start_height": write_number(numbers.start_height, ".3f"),
        "weight": write_number(body.total_mass() * GRAVITY, ".3g"),
        "leg": write_number(stance.leg_length, ".2g"),
        "stiffness": write_number(numbers.stiffness, "g"),
        "damping": write_number(numbers.damping, "g"),
        "armature": write_number(numbers.armature, "g"),
        "gear_damping": write_number(numbers.gear_damping, "g"),
        "max_force": _write_forces(forces),
        "force_comment": force_comment,
        "lowest": join_source(write_number(value, "g") for value in numbers.lowest),
        "highest": join_source(write_number(value, "g") for value in numbers.highest),
        "speed_scale": write_number(numbers.speed_scale, "g"),
        "turn_scale": write_number(numbers.turn_scale, "g"),
        "tolerance": write_number(numbers.tolerance, "g"),
        "smaller": write_number(numbers.tolerance / 2, "g"),
        "push": write_number(numbers.push, "g"),
        "bounce_weight": write_number(numbers.bounce, "g"),
        "sway_weight": write_number(numbers.sway, "g"),
        "start_noise": "0.05" if legged.is_biped else "0.1",
        **_describe_steps(legged),
        **({} if legged.motors is None else legged.motors.write(legged.guesses, "robot", "JOINTS")),
        "height_weight": write_number(numbers.height, "g"),
        "feet": write_list("FEET = ", map(write_string, sorted(set(legged.feet)))),
        "steps_up": str(steps),
        "steps_comment": steps_comment,
    }


def _describe_steps(legged: _Legged) -> dict[str, str]:
    names, numbers, gait = legged.body.joint_names, legged.scaled, legged.gait
    vector, turn = ("(-1, 2, 3)", "(1, -2, -3)") if gait.faces_y else ("(1, -2, 3)", "(-1, 2, -3)")
    command = "(-1, 2, -3)" if gait.faces_y else "(1, -2, -3)"
    return {
        "model_robot": "a humanoid" if legged.is_biped else "the A1",
        "other_side": f"({', '.join(map(str, gait.other_side))})",
        "mirror_vector": vector,
        "mirror_turn": turn,
        "mirror_command": command,
        "clips": list_files(legged.clips),
        "both_sides": SourceText(", OTHER_SIDE" if gait.other_side else ""),
        "period": write_number(numbers.period, "g"),
        "swing": write_number(numbers.swing, "g"),
        "least_swing": write_number(numbers.swing / 7, ".2g"),
        "feet_in_order": write_list("FEET = ", map(write_string, legged.feet)),
        "soles": SourceText(f"[{join_source(write_number(height, '.3f') for height in gait.soles)}]"),
        "aside": write_list("ASIDE = ", [write_string(names[joint]) for joint in gait.aside]),
        "total_timesteps": f"{_count_steps(legged):_}",
    }
