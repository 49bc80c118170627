"""Reads the files of clips as they are: CSV tables, NPZ files of mjlab, Isaac Lab and GMR, JSON frames of DeepMimic."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import ArtifactError, TaskError, UsageError
from rlctl.storage import files, untrusted
from rlctl.task.motion import find_rate

Array = NDArray[np.float64]
QuaternionOrder = Literal["xyzw", "wxyz"]
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
_TIMES = ("time", "times", "t", "timestamp", "times")
_ROOT_WORDS = re.compile(r"^(?:root|base|pelvis|trunk|torso|world)+")
_POSITION = re.compile(r"^(?:position|pos|translation|translate|trans)?([xyz])$")
_QUATERNION = re.compile(r"^(?:orientation|rotation|rot|quaternion|quat|q)+([xyzw])$")
LEAST_FRAMES = 3


@dataclasses.dataclass
class RawClip:
    """A clip as it is in its file."""

    root_position: Array
    quaternions: Array
    joints: Array
    names: list[str] | None = None  # of the joints
    quaternion: QuaternionOrder | None = None
    rate: float | None = None
    rate_source: str = ""


def read_raw(path: Path, joints: int) -> RawClip:
    """Read a file of a robot with so many joints; raises `UsageError` for one that is missing or damaged."""
    suffix = path.suffix.lower()
    if suffix in _OTHERS:
        raise UsageError(f"--motion {path}: {path.suffix} {_OTHERS[suffix]}")
    if suffix not in (".csv", ".txt", ".json", ".npz"):
        raise UsageError(f"--motion {path}: give a .csv, .npz, or .json or .txt file")
    if not path.is_file():
        raise UsageError(f"--motion: no file {path}")
    try:
        raw = _read_npz(path) if suffix == ".npz" else _read_text(path, joints)
    except (ArtifactError, TaskError) as error:
        raise UsageError(f"--motion: {error}") from None
    _check_numbers(path, raw)
    return raw


def _read_text(path: Path, joints: int) -> RawClip:
    text = untrusted.read_bytes(path).decode(errors="replace").strip()
    return _read_json(path, text, joints) if text.startswith("{") else _read_csv(path, text, joints)


def _read_json(path: Path, text: str, joints: int) -> RawClip:
    """Read `Frames` of root position, quaternion and joints, and their `FrameDuration` [s], as DeepMimic has them."""
    try:
        content = json.loads(text)
    except ValueError as error:
        raise UsageError(f"--motion {path}: not JSON: {error}") from None
    frames = content.get("Frames")
    if not (isinstance(frames, list) and frames and all(isinstance(frame, list) for frame in frames)):
        raise UsageError(f"--motion {path}: JSON with {', '.join(content)}; expected Frames, a list of rows of numbers")
    for number, frame in enumerate(frames):
        if len(frame) != len(frames[0]) or not all(isinstance(value, int | float) for value in frame):
            raise UsageError(f"--motion {path}: frame {number} is not a row of {len(frames[0])} numbers, as the first")
    _check_count(path, len(frames))
    raw = _split_columns(path, np.array(frames, np.float64), joints)
    duration = content.get("FrameDuration")
    if isinstance(duration, int | float) and duration > 0:
        raw.rate, raw.rate_source = round(1 / duration, 3), "its FrameDuration"
    return raw


def _read_csv(path: Path, text: str, joints: int) -> RawClip:
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise UsageError(f"--motion {path}: the file is empty")
    comma = "," if "," in lines[0] else None
    first = [part.strip() for part in lines[0].split(comma)]
    has_names = not all(map(_is_number, first))
    rows = np.array(list(_read_rows(path, lines, comma, len(first), start=int(has_names))))
    _check_count(path, len(rows))
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


def _split_columns(path: Path, rows: Array, joints: int) -> RawClip:
    """Read a table without names: root position, quaternion, joints; before them a time, if it has one column more."""
    count = rows.shape[1]
    has_time = count == joints + 8 and bool((np.diff(rows[:, 0]) > 0).all())
    if count < 8:
        raise UsageError(
            f"--motion {path}: {count} columns; a clip without names has root x, y, z, a quaternion, and the joints"
        )
    start = int(has_time)
    raw = RawClip(rows[:, start : start + 3], rows[:, start + 3 : start + 7], rows[:, start + 7 :])
    if has_time:
        raw.rate, raw.rate_source = find_rate(rows[:, 0], path.name), "its first column"
    return raw


def _name_columns(path: Path, header: list[str], rows: Array) -> RawClip:
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
    raw = RawClip(rows[:, columns[:3]], rows[:, columns[3:]], rows[:, joints], [header[index] for index in joints])
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


def _read_npz(path: Path) -> RawClip:
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
    _check_count(path, frames)
    position, quaternions, joints = (np.asarray(values, np.float64) for values in (position, quaternions, joints))
    raw = RawClip(position, quaternions, joints)
    if source.startswith("body_"):
        raw.quaternion = "wxyz"
    _, names = find("joint_names", "dof_names")
    if names is not None and names.ndim == 1 and names.dtype.kind in "US":
        raw.names = [str(name) for name in names.tolist()]
    _, rate = find("fps", "rate", "frame_rate", "framerate")
    if rate is not None and rate.size == 1 and rate.dtype.kind in "fiu":
        raw.rate, raw.rate_source = float(rate.ravel()[0]), "its fps"
    return raw


def _check_count(path: Path, frames: int) -> None:
    if frames < LEAST_FRAMES:
        raise UsageError(f"--motion {path}: {frames} frames; a clip has at least {LEAST_FRAMES}")


def _check_numbers(path: Path, raw: RawClip) -> None:
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
