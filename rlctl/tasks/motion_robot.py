"""The robot of a starter plugin that follows clips: its motors, the links to compare, and the clips themselves."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError
from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion import MotionClip
from rlctl.tasks.clips import list_files, read_clips, write_clips
from rlctl.tasks.legged_robot import load_free
from rlctl.tasks.model_copy import copy_model, remove_floor, remove_sensors
from rlctl.tasks.scaling import GRAVITY
from rlctl.tasks.source_text import SourceText, join_source, write_list, write_number, write_string
from rlctl.tasks.starter_robot import StarterRobot, list_faults, name_robot

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

Array = NDArray[np.float64]
TEMPLATE = Path(__file__).with_name("template_motion")
"""Templates of the files that differ from those of an arm."""
_SUBSTEPS = 2  # per action, each of 10 ms
_ITERATIONS = 4  # of the solver, as the bundled tasks have it
_LITTLE_FRICTION = 0.05  # of a joint's torque limit: dry friction that its motor does not notice
_LONGEST = 10.0  # [s], of an episode
_ENDLESS_FORCE = 20.0  # of weight x height of the root
_GUESSED = 0.35  # of weight x height of the root, for a joint that carries the robot
_HELD = 3.0  # times the torque of gravity on what a joint moves, for one that does not
_MOTOR = 4000.0  # [1/s^2]: torque limit by inertia of a motor and its gears, where the model has none
_FARTHEST = 0.33  # of the height of the root
_PUSH = 0.2  # of the root of gravity x height of the root
_SLIDES = 2  # MuJoCo's number for a joint that slides
_MOST_LINKS = 16


@dataclasses.dataclass(frozen=True)
class _Follower:
    body: MujocoBody
    path: Path
    clips: list[MotionClip]
    links: list[str]
    forces: Array  # [N m]
    are_guessed: NDArray[np.bool_]
    armature: Array
    friction: Array  # [N m], dry friction of the joints in the model

    @property
    def kept_friction(self) -> Array:
        """Dry friction of the joints in the task [N m]: 0 where the motor does not notice it.

        Each joint with dry friction is a constraint that the solver iterates on in every step.
        """
        return np.where(self.friction <= _LITTLE_FRICTION * self.forces, 0.0, self.friction)

    @property
    def loses_friction(self) -> bool:
        """Whether the task leaves out dry friction that the model has."""
        return bool((self.kept_friction < self.friction).any())

    @property
    def size(self) -> float:
        """Height of the root above the ground, the median of all frames [m]."""
        return float(np.median(np.concatenate([clip.root_position[:, 2] for clip in self.clips])))


def read_motion_robot(model: str, motions: Sequence[str], options: ClipOptions) -> StarterRobot:
    """Read a user's robot with a free base, and the clips that it is to follow.

    Raises `UsageError` for a file that is missing or cannot be loaded, a fixed base, and a clip that does not fit.
    """
    path, body = _load(model)
    clips, notes = read_clips(body, motions, options)
    size = float(np.median(np.concatenate([clip.root_position[:, 2] for clip in clips])))
    if size <= 0:
        raise UsageError(f"--motion: the root is {size:.3g} m above the ground on average; z must be upwards, in m")
    forces, are_guessed = _find_forces(body, clips[0], size)
    own = body._sim.model.dof_armature[body.parts.velocities].copy()
    friction = body._sim.model.dof_frictionloss[body.parts.velocities].copy()
    armature = np.where(own > 0, own, np.array([float(f"{force / _MOTOR:.2g}") for force in forces]))
    follower = _Follower(body, path, clips, _choose_links(body), forces, are_guessed, armature, friction)
    files = copy_model(path)
    notes += remove_floor(files, Path(path.name))
    notes += remove_sensors(files, Path(path.name))
    files |= write_clips(clips)
    kept = {"many" if len(clips) > 1 else "one"}
    if follower.loses_friction:
        kept.add("friction")
    summary = _summarize(follower, notes)
    return StarterRobot(_describe(follower), files, summary, template=TEMPLATE, kept=frozenset(kept))


def _load(model: str) -> tuple[Path, MujocoBody]:
    """Load a robot that a clip can move; raises `UsageError`."""
    path, body = load_free(model, "--motion")
    if not body.joint_names:
        raise UsageError(f"--model {model}: it has no joints")
    if body.fixed:
        raise UsageError(
            f"--model {model}: its base is fixed, and a clip moves it; add <freejoint/> to the body {body.base_name!r}"
        )
    kinds = body._sim.model.jnt_type[body.parts.joints].tolist()
    sliding = [name for name, kind in zip(body.joint_names, kinds, strict=True) if kind == _SLIDES]
    if sliding:
        raise UsageError(f"--model {model}: joint {sliding[0]!r} slides; --motion needs joints that rotate")
    return path, body


def _find_forces(body: MujocoBody, clip: MotionClip, size: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the torque limits of all joints [N m], and which of them are guesses."""
    model = body._sim.model
    weight = body.total_mass() * GRAVITY
    limits = np.where(np.isfinite(body.joint_max_force), body.joint_max_force, 0.0)
    are_guessed = (limits <= 0) | (limits > _ENDLESS_FORCE * weight * size)
    guesses = np.zeros(len(limits))
    for index, joint in enumerate(body.parts.joints):
        link = int(model.jnt_bodyid[joint])
        moved = float(model.body_subtreemass[link]) * GRAVITY
        is_arm = moved < 0.15 * weight and not _is_lowest(body, link, clip, size)
        guesses[index] = _HELD * moved * 0.3 * size if is_arm else _GUESSED * weight * size
    rounded = np.array([float(f"{guess:.2g}") for guess in guesses])
    return np.where(are_guessed, rounded, limits), are_guessed


def _is_lowest(body: MujocoBody, link: int, clip: MotionClip, size: float) -> bool:
    """Return whether a link is in a leg: lower than half of the root's height in the last frame that was placed."""
    return float(body._sim.data.xpos[link, 2]) < 0.6 * size


def _choose_links(body: MujocoBody) -> list[str]:
    """Return the links to compare: the ends of chains of joints, and links such as knees and elbows."""
    model = body._sim.model
    moved = [int(model.jnt_bodyid[joint]) for joint in body.parts.joints]
    above: dict[int, int] = {}
    for link in moved:
        parent = int(model.body_parentid[link])
        while parent and parent not in moved:
            parent = int(model.body_parentid[parent])
        above[link] = parent
    chosen: list[int] = []
    for end in (link for link in moved if link not in above.values()):
        chain = [end]
        while above.get(chain[-1], 0):
            chain.append(above[chain[-1]])
        chosen += [_find_tip(body, end), chain[len(chain) // 3]]
    names = [body.parts.link_names[link] for link in sorted(set(chosen))]
    return names[:_MOST_LINKS]


def _find_tip(body: MujocoBody, link: int) -> int:
    """Return the last link that is fixed to a link, such as a foot, or the link itself."""
    parents = body._sim.model.body_parentid
    fixed = [child for child in body.parts.link_names if child != link and int(parents[child]) == link]
    return _find_tip(body, fixed[-1]) if fixed else link


def _summarize(follower: _Follower, notes: Sequence[str]) -> str:
    body = follower.body
    time = sum(clip.duration for clip in follower.clips)
    count = len(follower.clips)
    clips = f"{count} clips" if count > 1 else "a clip"
    first = (
        f"{follower.path.name}: {body.total_mass():.3g} kg, {len(body.joint_names)} joints, follows {clips} of "
        f"{time:.3g} s; compared are the joints, the root and {', '.join(follower.links)}"
    )
    more = list_faults(body)
    if follower.are_guessed.any():
        names = [name for name, guess in zip(body.joint_names, follower.are_guessed, strict=True) if guess]
        shown = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        more.append(f"The model has no useful torque limits for {shown}: write those of your motors into MAX_FORCE")
    if follower.loses_friction:
        lost = follower.friction[follower.kept_friction < follower.friction].max()
        more.append(
            f"The task leaves out dry friction of the joints, up to {lost:.2g} N m: their motors do not notice it, and "
            "it takes a quarter of the time of the physics. See FRICTION in task.py"
        )
    return ".\n".join([first, *notes, *more, "Comments with CHANGE in task.py mark what to adapt"])


def _describe(follower: _Follower) -> dict[str, str]:
    body, name, size = follower.body, name_robot(follower.path), follower.size
    longest = max(clip.duration for clip in follower.clips)
    guessed = "; CHANGE: a guess where the model has no limit" if follower.are_guessed.any() else ", as in the model"
    return {
        "robot": name,
        "robot_phrase": name,
        "model": follower.path.name,
        "joints": write_list("JOINTS = ", map(write_string, body.joint_names)),
        "clips": list_files(follower.clips),
        "links": write_list("LINKS = ", map(write_string, follower.links)),
        "size": write_number(size, ".3f"),
        "max_force": write_list("MAX_FORCE = np.array(", map(write_number, follower.forces), ")"),
        "force_comment": guessed,
        "armature": write_list("ARMATURE = np.array(", map(write_number, follower.armature), ")"),
        "armature_comment": SourceText(),
        "friction": _write_friction(follower.kept_friction),
        "farthest": write_number(_FARTHEST * size, ".2g"),
        "episode_s": write_number(min(_LONGEST, math.ceil(10 * longest) / 10), "g"),
        "substeps": str(_SUBSTEPS),
        "iterations": str(_ITERATIONS),
        "push": write_number(_PUSH * math.sqrt(GRAVITY * size), ".2g"),
        "total_timesteps": "6_000_000",
        "links_in_readme": SourceText(join_source(map(write_string, follower.links))),
    }


def _write_friction(friction: Array) -> SourceText:
    if not friction.any():
        return write_number(0.0)
    return SourceText(f"np.array({write_list('FRICTION = np.array(', map(write_number, friction), ')')})")
