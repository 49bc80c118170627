"""What a world contains, and what happened to it in an episode: bodies, joints, masses, contacts, falls."""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic_core import to_jsonable_python

_DROP_SHARE, _SMALLEST_DROP = 0.2, 0.01  # of the height at the reset; [m]
TIPPED = 45.0  # [degrees]


@dataclasses.dataclass(frozen=True)
class JointSummary:
    """A movable joint, and where it was after the reset."""

    name: str
    unit: Literal["rad", "m"]
    low: float | None  # limits in the model [unit]; None without
    high: float | None
    start: float  # [unit]
    max_force: float | None = None  # in the model [N m or N]; None if it has none
    max_speed: float | None = None  # in the model [unit/s]; None if it has none

    @property
    def is_outside(self) -> bool:
        """Whether the joint began outside its limits, by more than rounding."""
        low, high = (math.inf if limit is None else limit for limit in (self.low, self.high))
        return (self.low is not None and self.start < low - 1e-3) or self.start > high + 1e-3


@dataclasses.dataclass(frozen=True)
class BodySummary:
    """A body of the world, as it was built."""

    name: str
    mass: float  # [kg]
    links: int  # with the base
    base: Literal["fixed", "free", "rail"]  # rail: it travels on sliding joints without limits
    joints: list[JointSummary]


class Touch(NamedTuple):
    """A link of a body that touches another body, or its own."""

    body: str
    link: str
    other: str
    overlap: float  # the deepest [m]; 0 without


@dataclasses.dataclass(frozen=True)
class Contact:
    """A link of a body that touched another body, or its own, and when it did so first."""

    body: str
    link: str
    other: str
    step: int  # the first after which it touched; 1 is the start
    overlap: float  # after that step [m]


class Pose(NamedTuple):
    """Where the base of a body is, or the link that travels; world frame."""

    position: Any  # [m]
    orientation: Any  # quaternion (x, y, z, w)


class WorldReader(Protocol):
    """Reads a world without changing it."""

    def read_bodies(self) -> list[BodySummary]:
        """Return the bodies, and where their joints are."""

    def read_poses(self) -> Mapping[str, Pose]:
        """Return the poses of the bodies that are not fixed, by name."""

    def read_touches(self) -> Iterable[Touch]:
        """Return what the links of bodies with joints, or that are not fixed, touch after the last physics step."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """How a body that is not fixed moved in an episode: heights of its base [m], and how far it tipped."""

    body: str
    start: float
    lowest: float
    highest: float
    end: float
    tilt: float  # the largest angle between its vertical axis at the reset and later [degrees]
    dropped_at: int | None  # the step at which it had fallen by a fifth of its height above z = 0, and by 1 cm
    tipped_at: int | None  # the step at which it had tipped by 45 degrees
    lost_at: int | None  # the step from which its pose is not finite


@dataclasses.dataclass(frozen=True)
class WorldSummary:
    """What was seen in an episode."""

    seed: int
    bodies: list[BodySummary]
    contacts: list[Contact]  # in the order in which they began
    motions: list[Motion]  # of bodies that are not fixed
    dt: float | None  # time between two steps [s]

    def as_json(self) -> dict[str, Any]:
        """Return the summary as plain data; numbers that are not finite become None."""
        return dict(to_jsonable_python(self, inf_nan_mode="null"))


class WorldWatch:
    """Summarises an episode: call `read` after the reset, with step 0, and after every step."""

    def __init__(self, reader: WorldReader, seed: int, dt: float | None) -> None:
        self._reader, self._seed, self._dt = reader, seed, dt
        self._bodies: list[BodySummary] = []
        self._contacts: dict[tuple[str, str, str], Contact] = {}
        self._heights: dict[str, list[float]] = {}
        self._uprights: dict[str, list[tuple[float, float, float]]] = {}

    def read(self, step: int) -> None:
        """Read the world after a step."""
        if step == 0:
            self._bodies = self._reader.read_bodies()
        else:  # a reset may have moved bodies without looking for collisions
            for touch in self._reader.read_touches():
                if touch[:3] not in self._contacts:
                    self._contacts[touch[:3]] = Contact(touch.body, touch.link, touch.other, step, touch.overlap)
        for name, pose in self._reader.read_poses().items():
            self._heights.setdefault(name, []).append(float(pose.position[2]))
            self._uprights.setdefault(name, []).append(_find_upright(pose.orientation))

    def summarize(self) -> WorldSummary:
        """Return what was seen since the reset."""
        motions = [
            _describe_motion(name, np.array(heights), np.array(self._uprights[name]))
            for name, heights in self._heights.items()
        ]
        return WorldSummary(self._seed, self._bodies, list(self._contacts.values()), motions, self._dt)


def _find_upright(orientation: Any) -> tuple[float, float, float]:
    """Return the world's vertical axis in the frame of a body: the last row of its rotation matrix."""
    x, y, z, w = (float(part) for part in orientation)
    return 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


def _describe_motion(name: str, heights: NDArray[np.float64], uprights: NDArray[np.float64]) -> Motion:
    finite = np.isfinite(heights) & np.isfinite(uprights).all(axis=1)
    lost = None if finite.all() else int(np.argmin(finite))
    heights, uprights = heights[:lost], uprights[:lost]
    if not len(heights):
        return Motion(name, 0.0, 0.0, 0.0, 0.0, 0.0, None, None, lost_at=0)
    tilts = np.degrees(np.arccos(np.clip(uprights @ uprights[0], -1.0, 1.0)))
    start = float(heights[0])
    return Motion(
        body=name,
        start=start,
        lowest=float(heights.min()),
        highest=float(heights.max()),
        end=float(heights[-1]),
        tilt=float(tilts.max()),
        dropped_at=_find_first(start - heights > max(_SMALLEST_DROP, _DROP_SHARE * abs(start))),
        tipped_at=_find_first(tilts > TIPPED),
        lost_at=lost,
    )


def _find_first(flags: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(flags)) if flags.any() else None
