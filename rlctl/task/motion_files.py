"""Reads clips of other programs as motions of a robot: order of quaternions and joints, rate and frames."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import UsageError, did_you_mean
from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion import MotionClip
from rlctl.task.raw_clips import LEAST_FRAMES, QuaternionOrder, RawClip, read_raw
from rlctl.task.rotations import normalize

Array = NDArray[np.float64]
ORDERS: tuple[QuaternionOrder, ...] = ("xyzw", "wxyz")
LEFT_OUT = "-"
"""In `--clip-joints`: a column that the robot has no joint for."""
_RATE_IN_NAME = re.compile(r"(\d+(?:\.\d+)?)[ _-]?(?:hz|fps)", re.IGNORECASE)
_BESIDE = 0.05  # [rad], beyond a limit that still counts as within it


@dataclasses.dataclass(frozen=True)
class RobotJoints:
    """The joints of a robot, in the model's order."""

    file: str
    names: Sequence[str]
    breadth_first: Sequence[str]
    """The order in which Isaac Lab has them: those nearest to the root first."""
    low: Array
    high: Array
    rest: Array  # positions of joints that a clip lacks


def read_clip(file: str, joints: RobotJoints, options: ClipOptions) -> tuple[MotionClip, list[str]]:
    """Read a clip as a motion of all joints of a robot, in the model's order; return it with what was found.

    Raises `UsageError` for a file that is missing, damaged, or does not fit the robot.
    """
    path = Path(file)
    raw = read_raw(path, len(joints.names))
    first, last = _read_frames(path, options.frames, len(raw.joints))
    raw.root_position, raw.quaternions = raw.root_position[first:last], raw.quaternions[first:last]
    raw.joints = raw.joints[first:last]
    order, why = _choose_order(path, raw, options)
    rate, source = _choose_rate(path, raw, options)
    positions, found = _order_joints(path, raw, joints, options)
    columns = [order.index(axis) for axis in "xyzw"]
    motion = MotionClip(
        name=path.stem,
        rate=rate,
        root_position=raw.root_position,
        root_orientation=normalize(raw.quaternions[:, columns]),
        joint_names=list(joints.names),
        joint_positions=positions,
    )
    notes = [
        f"{path.name}: {len(motion)} frames at {rate:g} Hz ({source}), {motion.duration:.2f} s; "
        f"quaternions {order} ({why}); {found[0]}"
    ]
    return motion, [*notes, *found[1:]]


def _read_frames(path: Path, frames: str | None, count: int) -> tuple[int, int]:
    if frames is None:
        return 0, count
    match = re.fullmatch(r"(\d*):(\d*)", frames)
    if match is None:
        raise UsageError(f"--frames {frames}: give FIRST:LAST, such as 120:480")
    first, last = int(match[1] or 0), int(match[2] or count)
    if not 0 <= first <= last - LEAST_FRAMES or last > count:
        raise UsageError(f"--frames {frames}: {path.name} has the frames 0:{count}; choose at least {LEAST_FRAMES}")
    return first, last


def _choose_order(path: Path, raw: RawClip, options: ClipOptions) -> tuple[QuaternionOrder, str]:
    """Return the order of the quaternions, and how it is known."""
    if options.quaternion is not None:
        return _check_order(options.quaternion), "--quaternion"
    if raw.quaternion is not None:
        return raw.quaternion, "the file's names"
    scores = {order: _score_order(raw.quaternions, order) for order in ORDERS}
    best: QuaternionOrder = "xyzw" if scores["xyzw"] >= scores["wxyz"] else "wxyz"
    return best, "found: the root is upright"


def _check_order(text: str) -> QuaternionOrder:
    for order in ORDERS:
        if text == order:
            return order
    raise UsageError(f"--quaternion {text}: give xyzw or wxyz")


def _score_order(quaternions: Array, order: QuaternionOrder) -> float:
    """Return how upright the root is on average, and how far it has turned least; at most 1.5."""
    x, y, _, w = (quaternions[:, order.index(axis)] for axis in "xyzw")
    upright = 1 - 2 * (x**2 + y**2)
    return float(upright.mean() + 0.5 * np.abs(w).mean())


def _choose_rate(path: Path, raw: RawClip, options: ClipOptions) -> tuple[float, str]:
    if options.rate is not None:
        return options.rate, options.rate_option
    if raw.rate is not None and raw.rate > 0:
        return raw.rate, raw.rate_source
    if match := _RATE_IN_NAME.search(path.name):
        return float(match[1]), "its name"
    raise UsageError(
        f"--motion {path}: the file has no times and no rate; add {options.rate_option} 30, for frames per second"
    )


def _order_joints(path: Path, raw: RawClip, joints: RobotJoints, options: ClipOptions) -> tuple[Array, list[str]]:
    """Return the positions of all joints in the model's order, and what was found."""
    names, how = raw.names, "joints by their names"
    if options.joints:
        names, how = list(options.joints), "joints by --clip-joints"
        if len(names) != raw.joints.shape[1]:
            raise UsageError(
                f"--clip-joints: {len(names)} names, and {path.name} has {raw.joints.shape[1]} columns of joints"
            )
    if names is None:
        names, how = _guess_names(path, raw, joints)
    columns = _match_names(path, names, joints)
    positions = np.tile(joints.rest, (len(raw.joints), 1))
    lacking = []
    for index, name in enumerate(joints.names):
        if name in columns:
            column, sign = columns[name]
            positions[:, index] = sign * raw.joints[:, column]
        else:
            lacking.append(name)
    if len(lacking) == len(joints.names):
        raise UsageError(f"--motion {path}: none of its columns is a joint of {joints.file}")
    notes = [how]
    if lacking:
        notes.append(f"{path.name} has no column for {', '.join(lacking)}: constant")
    if turned := _find_turned(positions, joints):
        notes.append(
            f"finding: {path.name}: beyond the limits, and within them with the other sign: {', '.join(turned)}; give "
            f"{LEFT_OUT}{turned[0]} for {turned[0]} in --clip-joints"
        )
    return positions, notes


def _find_turned(positions: Array, joints: RobotJoints) -> list[str]:
    """Return the joints that turn the other way in the clip: most of their values fit with the other sign only."""
    low, high = joints.low - _BESIDE, joints.high + _BESIDE
    fit = ((positions >= low) & (positions <= high)).mean(axis=0)
    turned = ((-positions >= low) & (-positions <= high)).mean(axis=0)
    return [name for name, as_is, other in zip(joints.names, fit, turned, strict=True) if as_is < 0.1 and other > 0.9]


def _guess_names(path: Path, raw: RawClip, joints: RobotJoints) -> tuple[list[str], str]:
    count = raw.joints.shape[1]
    if count != len(joints.names):
        raise UsageError(
            f"--motion {path}: {count} columns of joints without names, and {joints.file} has {len(joints.names)} "
            f"joints; name them in their order with --clip-joints NAME,NAME,... ({LEFT_OUT} for one to leave out)"
        )
    beyond = {}
    for kind, names in (("the model's", joints.names), ("breadth-first, as Isaac Lab has it", joints.breadth_first)):
        places = [list(joints.names).index(name) for name in names]
        low, high = joints.low[places] - _BESIDE, joints.high[places] + _BESIDE
        beyond[kind] = int(((raw.joints < low) | (raw.joints > high)).sum()), list(names)
    (first, (outside, names)), (second, (others, other_names)) = beyond.items()
    if names == other_names:
        return names, f"joints in the order of {joints.file}"
    if others < outside:
        names, found = (
            other_names,
            f"joint order {second}: {others} values beyond the limits, {outside} in {first} order",
        )
    else:
        found = f"joint order {first}: {outside} values beyond the limits, {others} {second}"
    advice = "; if it is another one, give it with --clip-joints" if min(others, outside) else ""
    return names, found + advice


def _match_names(path: Path, names: Sequence[str], joints: RobotJoints) -> Mapping[str, tuple[int, int]]:
    """Return the column of each joint of the model that is named, and its sign: -1 for a name after a minus."""
    plain = {_simplify(name): name for name in joints.names}
    columns: dict[str, tuple[int, int]] = {}
    for index, given in enumerate(names):
        if given == LEFT_OUT:
            continue
        is_turned = given.startswith(LEFT_OUT) and given not in joints.names
        name = given.removeprefix(LEFT_OUT) if is_turned else given
        joint = name if name in joints.names else plain.get(_simplify(name))
        if joint is None:
            raise UsageError(
                f"--motion {path}: {joints.file} has no joint {name!r}.{did_you_mean(name, joints.names)} Name the "
                f"columns in their order with --clip-joints NAME,NAME,... ({LEFT_OUT} for one to leave out)"
            )
        if joint in columns:
            raise UsageError(f"--motion {path}: two columns are the joint {joint!r}")
        columns[joint] = (index, -1 if is_turned else 1)
    return columns


def _simplify(name: str) -> str:
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    return re.sub(r"(joint|dof)", "", plain)
