"""Observations that are computed from measured quantities, by formulas that simulation and exported controllers share.

    observation_terms = {"gravity": terms.Gravity("orientation"), "last_action": terms.LastAction()}

For these names `Task.observe` returns the measured quantities, an array or, for several, a tuple of arrays in the order
of `inputs`; the environment computes the observation. `rlctl export --controller` writes the same formulas as C and
ONNX, with the quantities as inputs of the file.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError

Numbers = tuple[float, ...]
_TWO_COLUMNS = 6  # numbers of two columns of a rotation matrix
Internal = Literal["", "last_action", "time"]
"""What a controller knows itself: nothing, its last action, or the time since the start of the episode [s]."""


class Term:
    """A function of measured quantities. `compute` uses operators and functions of NumPy that act on elements only,
    so that it also takes the symbols from which the export writes code."""

    @property
    def internal(self) -> Internal:
        """What a controller knows itself, which `compute` takes after the inputs."""
        return ""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the quantities that a robot measures; none for what a controller knows itself."""
        return ()

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the parts of the observation, joined along the last axis later; quantities have shape (..., size)."""
        raise NotImplementedError

    def __call__(self, observed: Any) -> NDArray[np.float64]:
        """Return the observation for what `Task.observe` returned; raises `ValueError` where they do not fit."""
        given = observed if isinstance(observed, tuple) else (observed,)
        count = len(self.inputs) + bool(self.internal)
        if len(given) != count:
            raise ValueError(f"{len(given)} quantities, expected {count}")
        parts = self.compute(*[_as_vector(value) for value in given])
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)


def _as_vector(value: Any) -> NDArray[np.float64]:
    array = np.asarray(value, np.float64)
    return array if array.ndim else array[None]


@dataclasses.dataclass(frozen=True)
class Scaled(Term):
    """`(quantity - offset) * scale` within `clip`: joint positions from the default pose, for example."""

    quantity: str
    offset: Numbers = ()  # one number per element, or one for all, in the quantity's unit; none: 0
    scale: Numbers = ()  # none: 1
    clip: Numbers = ()  # lowest and highest value of the result; none: no limits
    kind: Literal["scaled"] = "scaled"

    def __post_init__(self) -> None:
        for key in ("offset", "scale", "clip"):
            object.__setattr__(self, key, _read_numbers(getattr(self, key), f"Scaled({self.quantity!r}).{key}"))
        if len(self.clip) not in (0, 2):
            raise TaskError(f"Scaled({self.quantity!r}).clip must be the lowest and the highest value")

    @property
    def inputs(self) -> tuple[str, ...]:
        """The quantity."""
        return (self.quantity,)

    @functools.cached_property
    def _arrays(self) -> list[NDArray[np.float64]]:
        return [np.array(numbers) for numbers in (self.offset, self.scale)]

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the shifted, scaled and clipped quantity."""
        (value,), (offset, scale) = quantities, self._arrays
        for numbers in (offset, scale):
            if len(numbers) not in (0, 1, value.shape[-1]):
                raise ValueError(f"{len(numbers)} numbers for {value.shape[-1]} elements")
        value = value - offset if len(offset) else value
        value = value * scale if len(scale) else value
        if self.clip:
            value = np.minimum(np.maximum(value, self.clip[0]), self.clip[1])
        return [value]


@dataclasses.dataclass(frozen=True)
class OrientationTerm(Term):
    """A function of one body's orientation as a unit quaternion (x, y, z, w)."""

    orientation: str = "orientation"

    @property
    def inputs(self) -> tuple[str, ...]:
        """The orientation."""
        return (self.orientation,)


def split_quaternion(orientation: Any) -> list[Any]:
    """Return x, y, z and w, each of shape (..., 1); raises `ValueError` for another number of elements."""
    if orientation.shape[-1] != 4:
        raise ValueError(f"a quaternion of {orientation.shape[-1]} elements")
    return [orientation[..., index : index + 1] for index in range(4)]


@dataclasses.dataclass(frozen=True)
class Gravity(OrientationTerm):
    """Direction of gravity in a body's frame, shape (3,), from its orientation as a unit quaternion (x, y, z, w)."""

    kind: Literal["gravity"] = "gravity"

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the third row of the rotation matrix, times -1."""
        x, y, z, w = split_quaternion(*quantities)
        # In the order of `rotate_inverse(orientation, (0, 0, -1))`, whose bits it has: 0.0 removes the sign of zeros.
        return [
            0.0 + w * (2.0 * y) - z * (2.0 * x),
            0.0 - w * (2.0 * x) - z * (2.0 * y),
            x * (2.0 * x) + y * (2.0 * y) - 1.0,
        ]


@dataclasses.dataclass(frozen=True)
class Euler(OrientationTerm):
    """Roll, pitch and yaw [rad], shape (3,), from a body's orientation as a unit quaternion (x, y, z, w)."""

    kind: Literal["euler"] = "euler"

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the angles about x, y and z."""
        x, y, z, w = split_quaternion(*quantities)
        sine = np.minimum(np.maximum(2.0 * (w * y - z * x), -1.0), 1.0)
        roll = _find_angle(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        yaw = _find_angle(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        pitch = np.arctan(sine / np.sqrt(np.maximum(1.0 - sine * sine, 1e-24)))
        return [roll, pitch, yaw]


def _find_angle(sine: Any, cosine: Any) -> Any:
    """Return the angle in (-pi, pi] of a point; ONNX has no function of both coordinates."""
    length = np.maximum(np.sqrt(sine * sine + cosine * cosine), 1e-12)
    sign = 1.0 + 2.0 * np.minimum(np.floor(sine / length), 0.0)  # -1 for sines below 0, else 1
    # Half the angle; the small numbers decide at pi, where both others are 0.
    return sign * 2.0 * np.arctan((sign * sine + 1e-12) / np.maximum(length + cosine, 1e-24))


@dataclasses.dataclass(frozen=True)
class Displacement(Term):
    """The vector from one position to another, such as from a hand to its goal, in the frame of both."""

    to: str
    start: str
    kind: Literal["displacement"] = "displacement"

    @property
    def inputs(self) -> tuple[str, ...]:
        """The end and the start of the vector."""
        return (self.to, self.start)

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the vector."""
        to, start = quantities
        if to.shape[-1] != start.shape[-1]:
            raise ValueError(f"positions of {to.shape[-1]} and of {start.shape[-1]} elements")
        return [to - start]


@dataclasses.dataclass(frozen=True)
class Distance(Displacement):
    """The distance between two positions, shape (1,)."""

    kind: Literal["distance"] = "distance"  # type: ignore[assignment]

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the length of the difference."""
        (difference,) = super().compute(*quantities)
        squares = [difference[..., index : index + 1] for index in range(difference.shape[-1])]
        return [np.sqrt(sum((part * part for part in squares[1:]), squares[0] * squares[0]))]


@dataclasses.dataclass(frozen=True)
class LastAction(Term):
    """The action of the step before, within its bounds; zeros at the start. `observe` returns it."""

    kind: Literal["last_action"] = "last_action"

    @property
    def internal(self) -> Internal:
        """The last action."""
        return "last_action"

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the action unchanged."""
        return [*quantities]


@dataclasses.dataclass(frozen=True)
class PhaseClock(Term):
    """Sine and cosine of a phase that runs through a circle in `period_s`; `observe` returns the time of the episode,
    shape (1,) [s]: 0 at the first observation, one `control_dt` more in each step.

    With several `offsets`, in parts of the period, these are all sines and then all cosines: of each leg, for example.
    """

    period_s: float
    offsets: Numbers = (0.0,)
    kind: Literal["phase_clock"] = "phase_clock"

    @property
    def internal(self) -> Internal:
        """The time."""
        return "time"

    def __post_init__(self) -> None:
        if not 0.0 < self.period_s < math.inf:
            raise TaskError(f"PhaseClock: period_s is {self.period_s}; it must be a time above 0 [s]")
        object.__setattr__(self, "offsets", _read_numbers(self.offsets, "PhaseClock: offsets"))

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the sines, then the cosines."""
        (time,) = quantities
        if time.shape[-1] != 1:
            raise ValueError(f"a time of {time.shape[-1]} elements")
        angles = []
        for offset in self.offsets:
            turns = time / self.period_s
            turns = turns + offset if offset else turns
            angles.append((turns - np.floor(turns)) * (2.0 * math.pi))
        return [*(np.sin(angle) for angle in angles), *(np.cos(angle) for angle in angles)]


@dataclasses.dataclass(frozen=True)
class Playback(Term):
    """A row of a table, one per `dt` [s], at the time of the episode: what a clip wants now. The last row stays.

    With `quantity` the observation is that quantity minus the row. With `time`, the name of an input [s], a robot says
    which row it is; otherwise the controller counts from the first row on. `observe` returns the quantity, if there is
    one, and then the time, shape (1,) [s].
    """

    table: Sequence[Sequence[float]]
    dt: float
    quantity: str = ""
    time: str = ""
    kind: Literal["playback"] = "playback"

    def __post_init__(self) -> None:
        rows = np.asarray(self.table, np.float64)
        if rows.ndim != 2 or not rows.size or not np.isfinite(rows).all():
            raise TaskError(f"Playback: table has the shape {rows.shape}; it must be rows of finite numbers")
        if not 0.0 < self.dt < math.inf:
            raise TaskError(f"Playback: dt is {self.dt}; it must be a time above 0 [s]")
        object.__setattr__(self, "table", tuple(map(tuple, np.round(rows, 6).tolist())))

    @property
    def inputs(self) -> tuple[str, ...]:
        """The quantity and the time, as far as they are inputs."""
        return tuple(name for name in (self.quantity, self.time) if name)

    @property
    def internal(self) -> Internal:
        """The time, unless it is an input."""
        return "" if self.time else "time"

    @functools.cached_property
    def rows(self) -> NDArray[np.float64]:
        """The table as an array, shape (rows, size)."""
        return np.array(self.table)

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the row of the time, or the quantity minus the row."""
        *given, time = quantities
        if time.shape[-1] != 1:
            raise ValueError(f"a time of {time.shape[-1]} elements")
        row = self._find_row(time)
        if not given:
            return [row]
        if given[0].shape[-1] != len(self.table[0]):
            raise ValueError(f"{given[0].shape[-1]} elements, and a row has {len(self.table[0])}")
        return [given[0] - row]

    def _find_row(self, time: Any) -> Any:
        number = np.minimum(np.maximum(np.floor(time / self.dt + 0.5), 0.0), float(len(self.table) - 1))
        if isinstance(number, np.ndarray):
            return self.rows[number[..., 0].astype(int)]
        return number.look_up(self.rows)


@dataclasses.dataclass(frozen=True)
class ClipOrientation(Playback):
    """The orientation that a clip wants of a body, as the body sees it: two columns of a rotation matrix, shape (6,).

    `quantity` is the body's orientation as a unit quaternion (x, y, z, w); rows of the table are the first two columns
    of the clip's rotation matrix, one after the other. The observation has the matrix of inverse(quantity) * clip row
    by row: elements (0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1).
    """

    kind: Literal["clip_orientation"] = "clip_orientation"  # type: ignore[assignment]

    def compute(self, *quantities: Any) -> list[Any]:
        """Return the six elements."""
        orientation, time = quantities
        if time.shape[-1] != 1 or len(self.table[0]) != _TWO_COLUMNS:
            raise ValueError(f"a time of {time.shape[-1]} elements, and rows of {len(self.table[0])} numbers")
        x, y, z, w = split_quaternion(orientation)
        axes = [  # of the body, in the world
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
            (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
            (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
        ]
        row = self._find_row(time)
        numbers = [row[..., index : index + 1] for index in range(_TWO_COLUMNS)]
        columns = numbers[:3], numbers[3:]
        return [axis[0] * column[0] + axis[1] * column[1] + axis[2] * column[2] for axis in axes for column in columns]


def find_quantity_sizes(terms: Mapping[str, Term], measured: Mapping[str, Any]) -> dict[str, int]:
    """Return the sizes of the quantities from which terms were computed; raises `TaskError` for one of two sizes."""
    sizes: dict[str, int] = {}
    for name, term in terms.items():
        values = measured[name] if isinstance(measured[name], tuple) else (measured[name],)
        for quantity, value in zip(term.inputs, values, strict=False):
            if sizes.setdefault(quantity, int(np.size(value))) != np.size(value):
                raise TaskError(f"the quantity {quantity!r} of term {name!r} has two sizes")
    return sizes


def _read_numbers(values: float | Sequence[float], where: str) -> Numbers:
    numbers = tuple(np.atleast_1d(np.asarray(values, np.float64)).tolist())
    if not all(map(math.isfinite, numbers)):
        raise TaskError(f"{where} must be finite, but is {list(numbers)}")
    return numbers
