"""Reads clips of other programs: CSV tables with or without names, and the NPZ files of mjlab, Isaac Lab and GMR."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, TaskError, UsageError, did_you_mean
from rlctl.storage import files, untrusted
from rlctl.task.clip_options import ClipOptions
from rlctl.task.motion import MotionClip, find_rate
from rlctl.task.rotations import normalize

Array = NDArray[np.float64]
QuaternionOrder = Literal["xyzw", "wxyz"]
ORDERS: tuple[QuaternionOrder, ...] = ("xyzw", "wxyz")
LEFT_OUT = "-"
"""In `--clip-joints`: a column that the robot has no joint for."""
_RETARGET = (
    "is a motion of a person or an animal, not of this robot: retarget it first, with GMR "
    "(github.com/YanjieZe/GMR) for example, and give its CSV of root position, quaternion and joints"
)
_OTHERS = {
    ".bvh": _RETARGET,
    ".fbx": _RETARGET,
    ".c3d": _RETARGET,
    ".amc": _RETARGET,
    ".pkl": "is a pickle, which can run code when it is read: save it as CSV or as .npz without objects",
}
_RATE_IN_NAME = re.compile(r"(\d+(?:\.\d+)?)[ _-]?(?:hz|fps)", re.IGNORECASE)
_TIMES = ("time", "times", "t", "timestamp", "times")
_ROOT_WORDS = re.compile(r"^(?:root|base|pelvis|trunk|torso|world)+")
_POSITION = re.compile(r"^(?:position|pos|translation|translate|trans)?([xyz])$")
_QUATERNION = re.compile(r"^(?:orientation|rotation|rot|quaternion|quat|q)+([xyzw])$")
_LEAST_FRAMES = 3
_BESIDE = 0.05  # [rad], beyond a limit that still counts as within it


@dataclasses.dataclass
class _Raw:
    """A clip as it is in its file."""

    root_position: Array
    quaternions: Array
    joints: Array
    names: list[str] | None = None  # of the joints
    quaternion: QuaternionOrder | None = None
    rate: float | None = None
    rate_source: str = ""


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
    raw = _read(path, len(joints.names))
    _check_numbers(path, raw)
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


def _read(path: Path, joints: int) -> _Raw:
    suffix = path.suffix.lower()
    if suffix in _OTHERS:
        raise UsageError(f"--motion {path}: {path.suffix} {_OTHERS[suffix]}")
    if suffix not in (".csv", ".txt", ".npz"):
        raise UsageError(f"--motion {path}: give a .csv or an .npz file")
    if not path.is_file():
        raise UsageError(f"--motion: no file {path}")
    try:
        return _read_npz(path) if suffix == ".npz" else _read_csv(path, joints)
    except (ArtifactError, TaskError) as error:
        raise UsageError(f"--motion: {error}") from None


def _read_csv(path: Path, joints: int) -> _Raw:
    lines = [line for line in untrusted.read_bytes(path).decode(errors="replace").splitlines() if line.strip()]
    if not lines:
        raise UsageError(f"--motion {path}: the file is empty")
    comma = "," if "," in lines[0] else None
    first = [part.strip() for part in lines[0].split(comma)]
    has_names = not all(map(_is_number, first))
    rows = np.array(list(_read_rows(path, lines, comma, len(first), start=int(has_names))))
    if len(rows) < _LEAST_FRAMES:
        raise UsageError(f"--motion {path}: {len(rows)} frames; a clip has at least {_LEAST_FRAMES}")
    return _name_columns(path, first, rows) if has_names else _split_columns(path, rows, joints)


def _read_rows(path: Path, lines: list[str], comma: str | None, count: int, start: int) -> Iterator[list[float]]:
    for number, line in enumerate(lines[start:], start=start + 1):
        parts = line.split(comma)
        if len(parts) != count:
            raise UsageError(f"--motion {path}: line {number} has {len(parts)} columns, the first has {count}")
        try:
            yield [float(part) for part in parts]
        except ValueError as error:
            raise UsageError(f"--motion {path}: line {number}: {error}") from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _split_columns(path: Path, rows: Array, joints: int) -> _Raw:
    """Read a table without names: root position, quaternion, joints; before them a time, if it has one column more."""
    count = rows.shape[1]
    has_time = count == joints + 8 and bool((np.diff(rows[:, 0]) > 0).all())
    if count < 8:
        raise UsageError(
            f"--motion {path}: {count} columns; a clip without names has root x, y, z, a quaternion, and the joints"
        )
    start = int(has_time)
    raw = _Raw(rows[:, start : start + 3], rows[:, start + 3 : start + 7], rows[:, start + 7 :])
    if has_time:
        raw.rate, raw.rate_source = find_rate(rows[:, 0], path.name), "its first column"
    return raw


def _name_columns(path: Path, header: list[str], rows: Array) -> _Raw:
    places: dict[str, int] = {}
    joints: list[int] = []
    for index, name in enumerate(header):
        kind = _find_kind(name)
        if kind and kind not in places:
            places[kind] = index
        elif kind != "frame":
            joints.append(index)
    wanted = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    if missing := [name for name in wanted if name not in places]:
        raise UsageError(
            f"--motion {path}: no column for {missing[0]!r} of the root; name them root_x, root_y, root_z, root_qx, "
            "root_qy, root_qz, root_qw, or leave out the line of names"
        )
    columns = [places[name] for name in wanted]
    raw = _Raw(rows[:, columns[:3]], rows[:, columns[3:]], rows[:, joints], [header[index] for index in joints])
    raw.quaternion = "xyzw"
    if "time" in places:
        raw.rate, raw.rate_source = find_rate(rows[:, places["time"]], path.name), "its times"
    return raw


def _find_kind(name: str) -> str:
    """Return what a column has by its name: time, frame, x, y, z, qx, qy, qz or qw of the root; empty for a joint."""
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    if plain in _TIMES:
        return "time"
    if plain in ("frame", "index"):
        return "frame"
    plain = _ROOT_WORDS.sub("", plain)
    if match := _QUATERNION.match(plain):
        return f"q{match[1]}"
    match = _POSITION.match(plain)
    return match[1] if match else ""


def _read_npz(path: Path) -> _Raw:
    arrays = files.read_npz(path)

    def find(*names: str) -> tuple[str, Any]:
        for name in names:
            if name in arrays:
                return name, np.asarray(arrays[name])
        return "", None

    _, joints = find("joint_pos", "dof_positions", "dof_pos", "joint_positions")
    source, position = find("body_pos_w", "body_positions", "root_pos", "root_position")
    _, quaternions = find("body_quat_w", "body_rotations", "root_rot", "root_quat", "root_orientation")
    if joints is None or position is None or quaternions is None:
        raise UsageError(
            f"--motion {path}: it has {', '.join(sorted(arrays)) or 'no arrays'}; expected joint_pos, body_pos_w and "
            "body_quat_w, as mjlab and Isaac Lab write them, or dof_pos, root_pos and root_rot"
        )
    if position.ndim == 3 and quaternions.ndim == 3:  # of all links; the root is the first
        position, quaternions = position[:, 0], quaternions[:, 0]
    shapes = [joints.shape, position.shape, quaternions.shape]
    frames = len(joints) if joints.ndim == 2 else 0
    if joints.ndim != 2 or position.shape != (frames, 3) or quaternions.shape != (frames, 4):
        raise UsageError(f"--motion {path}: joints, positions and quaternions of shapes {shapes} do not fit together")
    if frames < _LEAST_FRAMES:
        raise UsageError(f"--motion {path}: {frames} frames; a clip has at least {_LEAST_FRAMES}")
    position, quaternions, joints = (np.asarray(values, np.float64) for values in (position, quaternions, joints))
    raw = _Raw(position, quaternions, joints)
    if source.startswith("body_"):
        raw.quaternion = "wxyz"
    _, names = find("joint_names", "dof_names")
    if names is not None and names.ndim == 1 and names.dtype.kind in "US":
        raw.names = [str(name) for name in names.tolist()]
    _, rate = find("fps", "rate", "frame_rate", "framerate")
    if rate is not None and rate.size == 1 and rate.dtype.kind in "fiu":
        raw.rate, raw.rate_source = float(rate.ravel()[0]), "its fps"
    return raw


def _check_numbers(path: Path, raw: _Raw) -> None:
    table = np.column_stack([raw.root_position, raw.quaternions, raw.joints])
    bad = ~np.isfinite(table)
    if bad.any():
        frame, column = (int(index[0]) for index in np.nonzero(bad))
        raise UsageError(
            f"--motion {path}: frame {frame} is not finite in column {column} of root position, quaternion and joints"
        )
    lengths = np.linalg.norm(raw.quaternions, axis=1)
    if (np.abs(lengths - 1) > 0.1).any():
        frame = int(np.abs(lengths - 1).argmax())
        raise UsageError(
            f"--motion {path}: frame {frame} has a quaternion of length {lengths[frame]:.3g}, expected 1; "
            "the columns are x, y, z, a quaternion, and the joints"
        )


def _read_frames(path: Path, frames: str | None, count: int) -> tuple[int, int]:
    if frames is None:
        return 0, count
    match = re.fullmatch(r"(\d*):(\d*)", frames)
    if match is None:
        raise UsageError(f"--frames {frames}: give FIRST:LAST, such as 120:480")
    first, last = int(match[1] or 0), int(match[2] or count)
    if not 0 <= first <= last - _LEAST_FRAMES or last > count:
        raise UsageError(f"--frames {frames}: {path.name} has the frames 0:{count}; choose at least {_LEAST_FRAMES}")
    return first, last


def _choose_order(path: Path, raw: _Raw, options: ClipOptions) -> tuple[QuaternionOrder, str]:
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


def _choose_rate(path: Path, raw: _Raw, options: ClipOptions) -> tuple[float, str]:
    if options.rate is not None:
        return options.rate, options.rate_option
    if raw.rate is not None and raw.rate > 0:
        return raw.rate, raw.rate_source
    if match := _RATE_IN_NAME.search(path.name):
        return float(match[1]), "its name"
    raise UsageError(
        f"--motion {path}: the file has no times and no rate; add {options.rate_option} 30, for frames per second"
    )


def _order_joints(path: Path, raw: _Raw, joints: RobotJoints, options: ClipOptions) -> tuple[Array, list[str]]:
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
            positions[:, index] = raw.joints[:, columns[name]]
        else:
            lacking.append(name)
    if len(lacking) == len(joints.names):
        raise UsageError(f"--motion {path}: none of its columns is a joint of {joints.file}")
    notes = [how]
    if lacking:
        notes.append(f"{path.name} has no column for {', '.join(lacking)}: constant")
    return positions, notes


def _guess_names(path: Path, raw: _Raw, joints: RobotJoints) -> tuple[list[str], str]:
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


def _match_names(path: Path, names: Sequence[str], joints: RobotJoints) -> Mapping[str, int]:
    """Return the column of each joint of the model that is named."""
    plain = {_simplify(name): name for name in joints.names}
    columns: dict[str, int] = {}
    for index, name in enumerate(names):
        if name == LEFT_OUT:
            continue
        joint = name if name in joints.names else plain.get(_simplify(name))
        if joint is None:
            raise UsageError(
                f"--motion {path}: {joints.file} has no joint {name!r}.{did_you_mean(name, joints.names)} Name the "
                f"columns in their order with --clip-joints NAME,NAME,... ({LEFT_OUT} for one to leave out)"
            )
        if joint in columns:
            raise UsageError(f"--motion {path}: two columns are the joint {joint!r}")
        columns[joint] = index
    return columns


def _simplify(name: str) -> str:
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    return re.sub(r"(joint|dof)", "", plain)
