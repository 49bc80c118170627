"""`MotionClip`: a clip that a robot is to follow, as rows of time. Its file is a CSV table with a header and units.

The columns of a file are `time` [s], `root_x`, `root_y`, `root_z` [m], `root_qx`, `root_qy`, `root_qz`, `root_qw`, and
one per joint, [rad] or [m], named as the joint. Clips of other forms become such files by `rlctl tasks new --motion`.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.storage import untrusted
from rlctl.task.rotations import normalize

Array = NDArray[np.float64]
TIME = "time"
POSITION = ("root_x", "root_y", "root_z")
ORIENTATION = ("root_qx", "root_qy", "root_qz", "root_qw")
ROOT = (*POSITION, *ORIENTATION)
_STEADY = 0.02  # of the time between two frames, by which it may vary
_DECIMALS = 6
_TIME_DIGITS = 9  # of times, which are read back as equal steps also after minutes


@dataclasses.dataclass(frozen=True, eq=False)
class MotionClip:
    """A clip: a root, which is the base of the robot, and joints, in rows of equal time."""

    name: str
    rate: float  # [1/s]
    root_position: Array  # of the frame of the base in the world [m], shape (frames, 3)
    root_orientation: Array  # unit quaternions (x, y, z, w), shape (frames, 4)
    joint_names: Sequence[str]
    joint_positions: Array  # [rad or m], shape (frames, joints)

    def __len__(self) -> int:
        return len(self.root_position)

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self) - 1) / self.rate

    def resample(self, rate: float) -> "MotionClip":
        """Return the clip at another rate [1/s], linear between its frames, without what is left after the last row."""
        if rate == self.rate:
            return self
        count = int(np.floor(self.duration * rate + 1e-6)) + 1
        places = np.minimum(np.arange(count) * (self.rate / rate), len(self) - 1)
        before = np.minimum(places.astype(int), len(self) - 2)
        part = (places - before)[:, None]

        def blend(values: Array) -> Array:
            return values[before] * (1 - part) + values[before + 1] * part

        return dataclasses.replace(
            self,
            rate=rate,
            root_position=blend(self.root_position),
            root_orientation=normalize(blend(align_signs(self.root_orientation))),
            joint_positions=blend(self.joint_positions),
        )

    def take_joints(self, names: Sequence[str]) -> Array:
        """Return the positions of joints, shape (frames, names); raises `TaskError` for one that the clip lacks."""
        known = {name: index for index, name in enumerate(self.joint_names)}
        if missing := [name for name in names if name not in known]:
            raise TaskError(f"motion {self.name}: no column of the joint {missing[0]!r}")
        return self.joint_positions[:, [known[name] for name in names]]


def align_signs(quaternions: Array) -> Array:
    """Return the same orientations, each with the sign that is nearer to the one before it; shape (frames, 4)."""
    products = (quaternions[1:] * quaternions[:-1]).sum(axis=1)
    signs = np.cumprod(np.where(products < 0, -1.0, 1.0))
    return quaternions * np.concatenate([[1.0], signs])[:, None]


def read_motion(path: Path) -> MotionClip:
    """Read the file of a clip; raises `TaskError` or `ArtifactError` for a file without the columns."""
    header, *lines = untrusted.read_bytes(path).decode(errors="replace").splitlines() or [""]
    names = [name.strip() for name in header.split(",")]
    if missing := [name for name in (TIME, *ROOT) if name not in names]:
        raise TaskError(f"{path.name}: no column {missing[0]!r}; rlctl tasks new --motion writes such files")
    try:
        rows = np.loadtxt(lines, delimiter=",", ndmin=2)
    except ValueError as error:
        raise TaskError(f"{path.name}: {error}") from None
    if rows.shape[0] < 2 or rows.shape[1] != len(names) or not np.isfinite(rows).all():
        raise TaskError(f"{path.name}: expected at least 2 rows of {len(names)} finite numbers")
    columns = {name: rows[:, index] for index, name in enumerate(names)}
    joints = [name for name in names if name not in (TIME, *ROOT)]
    return MotionClip(
        name=path.stem,
        rate=find_rate(columns[TIME], path.name),
        root_position=np.column_stack([columns[name] for name in POSITION]),
        root_orientation=normalize(np.column_stack([columns[name] for name in ORIENTATION])),
        joint_names=joints,
        joint_positions=rows[:, [names.index(name) for name in joints]],
    )


def find_rate(times: Any, where: str) -> float:
    """Return the rate of times [s] at equal distances [1/s]; raises `TaskError` for others."""
    steps = np.diff(times)
    usual = float(np.median(steps))
    if not usual > 0:
        raise TaskError(f"{where}: the times do not rise")
    off = np.abs(steps - usual)
    row = int(off.argmax())
    if off[row] > _STEADY * usual + 10.0**-_DECIMALS:
        raise TaskError(
            f"{where}: {steps[row]:.4g} s from frame {row} to {row + 1}, and {usual:.4g} s elsewhere; "
            "resample it at equal times first"
        )
    rate = 1.0 / float(steps.mean())
    return float(round(rate)) if abs(rate - round(rate)) < _STEADY * rate / 10 else rate


def write_motion(motion: MotionClip) -> bytes:
    """Return a clip as the content of its file."""
    times = (np.arange(len(motion)) / motion.rate).tolist()
    rows = np.column_stack([motion.root_position, motion.root_orientation, motion.joint_positions])
    lines = [",".join([TIME, *ROOT, *motion.joint_names])]
    for time, row in zip(times, rows.tolist(), strict=True):
        numbers = [f"{value:.{_DECIMALS}g}" for value in row]
        lines.append(",".join([f"{time:.{_TIME_DIGITS}g}", *numbers]))
    return ("\n".join(lines) + "\n").encode()
