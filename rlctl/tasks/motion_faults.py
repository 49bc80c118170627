"""What is wrong with a clip of a robot, with its frames: found before any training."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.motion import MotionClip
from rlctl.task.rotations import invert, multiply
from rlctl.tasks.shapes import Shapes

if TYPE_CHECKING:
    from rlctl.task.mujoco.body import MujocoBody

Array = NDArray[np.float64]
_GRAVITY = 9.81  # [m/s^2]
_SUNK = 0.02  # [m], in the floor
_FLOATING = 0.05  # [m], above the floor in every frame
_MOST_SHIFT = 0.15  # [m], by which a clip is raised or lowered
_STANDING = 20  # percentile of the lowest points: the robot stands in these frames
_BESIDE = 0.02  # [rad], beyond a limit
_FASTEST = 25.0  # [rad/s], of a joint whose limit the model lacks
_JUMP = (40.0, 8.0, 25.0)  # of joints [rad/s], root [m/s], and turning [rad/s]: no clip moves so fast
_FALLING = 1.6  # times gravity, downwards
_WINDOW = 0.12  # [s], over which accelerations are averaged
_OFTEN = 0.05  # of the frames
_MOST_NAMES, _MOST_RANGES = 3, 4


@dataclasses.dataclass(frozen=True)
class Heights:
    """What the shapes of a robot do in a clip."""

    lowest: Array  # [m], of all shapes, shape (frames,)
    centre: Array  # [m], of the centre of mass, shape (frames,)


def measure_heights(body: MujocoBody, motion: MotionClip) -> Heights:
    """Return how high the lowest point and the centre of mass of a free body are, which is left in the last frame."""
    mujoco, model, data = body._sim.mujoco, body._sim.model, body._sim.data
    # A floor in the file belongs to the world, 0.
    shapes = Shapes(model, [geom for geom in body.parts.geoms if int(model.geom_bodyid[geom])])
    root = body.find_link(body.base_name)
    body.set_base((0.0, 0.0, 0.0))
    mujoco.mj_kinematics(model, data)
    start = body.parts.free[0] if body.parts.free is not None else 0
    places = model.jnt_qposadr[body.parts.joints]
    lowest, centre = np.zeros(len(motion)), np.zeros(len(motion))
    for frame in range(len(motion)):
        data.qpos[start : start + 3] = motion.root_position[frame]
        data.qpos[start + 3 : start + 7] = motion.root_orientation[frame][[3, 0, 1, 2]]
        data.qpos[places] = motion.joint_positions[frame]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        lowest[frame], centre[frame] = shapes.find_lowest(data), data.subtree_com[root, 2]
    return Heights(lowest, centre)


def find_shift(heights: Heights) -> float:
    """Return by how much a clip must be raised for the robot to stand on the floor [m]; 0 if that is no offset."""
    shift = -float(np.percentile(heights.lowest, _STANDING))
    return shift if 0.002 < abs(shift) <= _MOST_SHIFT else 0.0


def find_faults(body: MujocoBody, motion: MotionClip, heights: Heights) -> list[str]:
    """Return sentences without a full stop, each with the frames, counted from 0."""
    faults = [
        *_judge_floor(heights.lowest),
        *_judge_limits(body, motion),
        *_judge_speeds(body, motion),
        *_judge_jumps(motion),
        *_judge_falls(motion, heights.centre),
    ]
    return [f"{motion.name}: {fault}" for fault in faults]


def _judge_floor(lowest: Array) -> list[str]:
    sunk = lowest < -_SUNK
    if sunk.any():
        return [f"up to {100 * -lowest.min():.1f} cm through the floor in {list_frames(sunk)}"]
    if lowest.min() > _FLOATING:
        return [f"at least {100 * lowest.min():.1f} cm above the floor in every frame"]
    return []


def _judge_limits(body: MujocoBody, motion: MotionClip) -> list[str]:
    positions, low, high = motion.joint_positions, body.joint_low, body.joint_high
    beyond = np.maximum(np.maximum(low - positions, positions - high), 0.0)
    bad = beyond > _BESIDE
    if not bad.any():
        return []
    in_radians = np.deg2rad(positions)
    if bad.mean() > _OFTEN and ((in_radians < low) | (in_radians > high)).mean() < bad.mean() / 10:
        return ["the joints look like degrees: give them in radians"]
    found = _list_joints(motion.joint_names, bad, np.rad2deg(beyond), "{} by up to {:.0f} degrees")
    return [f"beyond the limits of the model: {found}"]


def _judge_speeds(body: MujocoBody, motion: MotionClip) -> list[str]:
    speeds = np.abs(np.gradient(motion.joint_positions, 1.0 / motion.rate, axis=0))
    known = body.joint_max_speed
    limits = np.where((known > 0) & np.isfinite(known), known, _FASTEST)
    bad = speeds > limits
    if not bad.any():
        return []
    found = _list_joints(motion.joint_names, bad, speeds, "{} up to {:.3g} rad/s")
    advice = ""
    if bad.any(axis=1).mean() > _OFTEN:
        advice = f"; is {motion.rate:g} Hz the right rate? Otherwise give --rate"
    return [f"faster than the motors: {found}{advice}"]


def _judge_jumps(motion: MotionClip) -> list[str]:
    joints = np.abs(np.diff(motion.joint_positions, axis=0)).max(axis=1, initial=0.0) * motion.rate
    root = np.linalg.norm(np.diff(motion.root_position, axis=0), axis=1) * motion.rate
    turns = multiply(motion.root_orientation[1:], invert(motion.root_orientation[:-1]))
    turning = 2 * np.arccos(np.clip(np.abs(turns[:, 3]), 0.0, 1.0)) * motion.rate
    speeds = np.stack([joints, root, turning])
    bad = (speeds > np.array(_JUMP)[:, None]).any(axis=0)
    if not bad.any():
        return []
    frame = int(bad.argmax())
    return [
        f"jumps to the frame after {list_frames(np.append(bad, False))}: to frame {frame + 1} the joints turn by "
        f"{joints[frame] / motion.rate:.2g} rad, and the root moves by {root[frame] / motion.rate:.2g} m"
    ]


def _judge_falls(motion: MotionClip, centre: Array) -> list[str]:
    """Nothing pulls a robot down but gravity, so a centre of mass that falls faster is played too fast, or jumps."""
    window = max(1, round(_WINDOW * motion.rate))
    if len(centre) < 3 * window:
        return []
    # The second difference over a window is the mean acceleration in it.
    falling = -(centre[2 * window :] - 2 * centre[window:-window] + centre[: -2 * window]) * (motion.rate / window) ** 2
    bad = falling > _FALLING * _GRAVITY
    if not bad.any():
        return []
    flags = np.concatenate([np.zeros(window, bool), bad, np.zeros(window, bool)])
    rate = motion.rate / np.sqrt(falling.max() / _GRAVITY)
    return [
        f"its centre of mass falls {falling.max() / _GRAVITY:.1f} times as fast as gravity pulls in "
        f"{list_frames(flags)}: the rate is too high ({rate:.0f} Hz would fit), or the clip jumps"
    ]


def _list_joints(names: Sequence[str], bad: Any, values: Array, form: str) -> str:
    columns = np.flatnonzero(bad.any(axis=0))
    worst = sorted(columns.tolist(), key=lambda column: -float(values[:, column].max()))
    texts = [form.format(names[column], float(values[:, column].max())) for column in worst[:_MOST_NAMES]]
    more = f" and {len(worst) - _MOST_NAMES} more" if len(worst) > _MOST_NAMES else ""
    return f"{', '.join(texts)}{more}, in {list_frames(bad.any(axis=1))}"


def list_frames(flags: Any) -> str:
    """Return the frames in which flags are true, such as `frames 12-30, 77`."""
    numbers = np.flatnonzero(flags)
    groups = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    ranges = [f"{group[0]}-{group[-1]}" if len(group) > 1 else f"{group[0]}" for group in groups]
    more = f" and {len(ranges) - _MOST_RANGES} more ranges" if len(ranges) > _MOST_RANGES else ""
    word = "frame" if len(numbers) == 1 else "frames"
    return f"{word} {', '.join(ranges[:_MOST_RANGES])}{more}"
