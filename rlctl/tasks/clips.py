"""The clips of a starter plugin: read for a robot, put on its floor, and written next to its task."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion import MotionClip, write_motion
from rlctl.task.motion_files import RobotJoints, read_clip
from rlctl.tasks.motion_faults import Heights, find_faults, find_shift, measure_heights
from rlctl.tasks.source_text import SourceText, write_list, write_string

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody


def read_clips(body: MujocoBody, motions: Sequence[str], options: ClipOptions) -> tuple[list[MotionClip], list[str]]:
    """Read clips of a robot as motions of all of its joints, standing on the floor; return them with what was found.

    Raises `UsageError` for a file that is missing, damaged, or does not fit the robot.
    """
    joints = _describe_joints(body)
    read = [read_clip(motion, joints, options) for motion in motions]
    notes = [note for _, found in read for note in found]
    clips: list[MotionClip] = []
    for clip, _ in read:
        standing, found = _put_on_floor(body, clip)
        clips.append(standing)
        notes += found
    return _name_clips(clips), notes


def write_clips(clips: Sequence[MotionClip]) -> dict[Path, bytes]:
    """Return the files of clips, relative to the package."""
    return {Path(f"{clip.name}.csv"): write_motion(clip) for clip in clips}


def list_files(clips: Sequence[MotionClip]) -> SourceText:
    """Return the code of a list of the clips' files, the value of CLIPS."""
    return write_list("CLIPS = ", [write_string(f"{clip.name}.csv") for clip in clips])


def _put_on_floor(body: MujocoBody, clip: MotionClip) -> tuple[MotionClip, list[str]]:
    """Return the clip at the height at which the robot stands on the floor, and what was found in it."""
    heights, notes = measure_heights(body, clip), []
    shift = find_shift(heights)
    if shift:
        how = "raised" if shift > 0 else "lowered"
        notes.append(f"{clip.name}: {how} by {100 * abs(shift):.1f} cm to the floor")
    moved = dataclasses.replace(clip, root_position=clip.root_position + np.array([0.0, 0.0, shift]))
    faults = find_faults(body, moved, Heights(heights.lowest + shift, heights.centre + shift))
    notes += [f"finding: {fault}" for fault in faults] or [f"{clip.name}: no findings"]
    return moved, notes


def _describe_joints(body: MujocoBody) -> RobotJoints:
    model, names = body._sim.model, body.joint_names
    depths = []
    for joint in body.parts.joints:
        link, depth = int(model.jnt_bodyid[joint]), 0
        while link:
            link, depth = int(model.body_parentid[link]), depth + 1
        depths.append(depth)
    order = sorted(range(len(names)), key=lambda index: depths[index])  # a stable sort
    low, high = body.joint_low, body.joint_high
    rest = np.clip(0.0, low, high)
    return RobotJoints(body.file.name, names, [names[index] for index in order], low, high, rest)


def _name_clips(clips: list[MotionClip]) -> list[MotionClip]:
    """Return clips with names of files that differ."""
    named: list[MotionClip] = []
    for clip in clips:
        plain = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in clip.name) or "clip"
        name, number = plain, 1
        while any(other.name == name for other in named):
            number += 1
            name = f"{plain}-{number}"
        named.append(dataclasses.replace(clip, name=name))
    return named
