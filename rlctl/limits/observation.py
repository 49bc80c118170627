"""Converts clients' observations to the form that the policy takes, and checks their values."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.errors import RecipeError, check_name, did_you_mean, short_repr
from rlctl.limits.limits import Limits
from rlctl.task.layout import Layout

Array = NDArray[Any]

_FLOAT64_SIZE = 8  # [bytes]
WHOLE = "observation"  # name of an observation whose parts have no names


class ObservationError(ValueError):
    """The data is not an observation of this policy; the message gives the reason."""


class ObservationReader:
    """Reads what clients send as observations of a policy, by name or as a flat vector."""

    def __init__(self, info: EnvInfo) -> None:
        self.space, _ = info.spaces()
        shape, sizes = self.space.shape or (), info.observation_sizes
        parts = split_space(self.space)
        self.shapes: dict[str, tuple[int, ...]] = {key: part.shape or () for key, part in parts.items()}
        """The shape of each named observation."""
        if SINGLE in parts:
            # The names describe a single observation, not a stack of them.
            named = len(shape) == 1 and sum(sizes.values()) == shape[0]
            self.shapes = {name: (size,) for name, size in sizes.items()} if named else {WHOLE: shape}
        self._dtypes = {name: np.dtype(parts.get(name, self.space).dtype) for name in self.shapes}
        numbers = [name for name in self.shapes if SINGLE in parts or not _is_image(parts[name])]
        self.layout = Layout({name: math.prod(self.shapes[name]) for name in numbers})
        """Place of each named observation in the flat vector, which has no images."""

    def read(self, values: Any) -> Any:
        """Return values by name, or the flat vector, in the policy's form; raises `ObservationError`."""
        if isinstance(values, dict):
            parts = self._read_names(values)
            if isinstance(self.space, spaces.Dict):
                return parts
            return np.concatenate([parts[name].ravel() for name in self.layout.columns]).reshape(self.space.shape or ())
        if isinstance(self.space, spaces.Dict):
            raise ObservationError(f"this policy takes observations by name: {', '.join(self.shapes)}")
        return _convert(values, WHOLE, self.space.shape or (), np.dtype(self.space.dtype))

    def _read_names(self, values: dict[Any, Any]) -> dict[str, Array]:
        known, problems = self.shapes, []
        if unknown := [name for name in values if name not in known]:
            close = did_you_mean(str(unknown[0]), known)
            problems.append(f"unknown: {_join(unknown)}{close and f' ({close.strip()})'}")
        if missing := [name for name in known if name not in values]:
            problems.append(f"missing: {_join(missing)}")
        if problems:
            raise ObservationError(f"observation names {'; '.join(problems)}")
        return {name: _convert(values[name], name, shape, self._dtypes[name]) for name, shape in known.items()}

    def name_parts(self, observation: Any) -> dict[str, Array]:
        """Return the parts of an observation by name, for `read`; the arrays share its memory."""
        if isinstance(self.space, spaces.Dict):
            return {name: np.asarray(observation[name]) for name in self.shapes}
        flat = np.asarray(observation).ravel()
        return {name: flat[part].reshape(self.shapes[name]) for name, part in self.layout.columns.items()}

    def flatten(self, observation: Any) -> NDArray[np.float64]:
        """Return the numbers of an observation without its images, shape (size,); raises `ObservationError`."""
        parts = split(observation)
        keys = [SINGLE] if SINGLE in parts else [*self.layout.columns]
        if missing := [key for key in keys if key not in parts]:
            raise ObservationError(f"observation names missing: {_join(missing)}")
        numbers = [read_numbers(parts[key]) for key in keys]
        values = numbers[0] if len(numbers) == 1 else np.concatenate([np.zeros(0), *numbers])
        if values.size != self.layout.size:
            raise ObservationError(f"the observation has {values.size} numbers, the policy takes {self.layout.size}")
        return values


def read_numbers(values: Any) -> NDArray[np.float64]:
    """Return a flat float64 copy of real numbers; raises `ObservationError` for everything else."""
    array = _read_array(values, "a value")
    if array.itemsize <= _FLOAT64_SIZE:  # no number is too large; entering `errstate` takes longer than the conversion
        return array.astype(np.float64).ravel()
    with np.errstate(over="ignore"):  # numbers too large for float64 become infinite
        return array.astype(np.float64).ravel()


def _read_array(values: Any, name: str) -> Array:
    if type(values) is np.ndarray and values.dtype.kind in "biuf":
        return values
    try:
        array = np.asarray(values)
    except Exception:  # lists of different lengths; an object's own conversion, such as a tensor's on a GPU
        array = np.array(None)
    if hasattr(values, "mask") and np.ma.is_masked(values):  # a missing measurement
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise ObservationError(f"{name} is not an array of numbers")
    return array


def _convert(value: Any, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    array = _read_array(value, f"observation {name!r}")
    if array.shape != shape:
        # A flat array is reshaped; otherwise only axes of length 1 may differ, so a transposed image is refused.
        axes, expected = ([axis for axis in sizes if axis != 1] for sizes in (array.shape, shape))
        if array.size != math.prod(shape) or (axes != expected and min(len(axes), len(expected)) > 1):
            raise ObservationError(f"observation {name!r} has shape {array.shape}, the policy takes {shape}")
        array = array.reshape(shape)
    if array.dtype != dtype:
        with np.errstate(all="ignore"):  # the sensor checks refuse numbers that are not finite
            original, array = array, array.astype(dtype)
        if dtype.kind in "iu" and (wrong := original[original != array]).size:
            raise ObservationError(f"observation {name!r} has {wrong.flat[0]:g}, the policy takes {dtype}")
    return array


def _join(names: list[Any]) -> str:
    return short_repr(", ".join(map(str, names)), 200)


def _is_image(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredPositions:
    """Where the flat observation has the joints' positions, and how it has them: `(position - offset) * scale`."""

    part: slice
    scale: Array | None = None  # None: the positions themselves
    offset: Array | None = None

    def read(self, values: Array) -> Array:
        """Return the positions in the joints' units, in which limits are written."""
        positions = values[self.part]
        positions = positions if self.scale is None else positions / self.scale
        return positions if self.offset is None else positions + self.offset

    def write(self, positions: Array) -> Array:
        """Return positions as the observation has them."""
        shifted = positions if self.offset is None else positions - self.offset
        return shifted if self.scale is None else shifted * self.scale


UNIT_SQUARES = 0.81, 1.21  # of the norm of a quaternion: from 0.9 to 1.1
_ROUNDING = 1e-6
_SIZE = 4  # of a quaternion


def find_quaternions(info: EnvInfo, slices: Mapping[str, slice]) -> list[str]:
    """Return the observations that are orientations as quaternions, by their units."""
    sizes = {name: part.stop - part.start for name, part in slices.items() if name not in info.observation_terms}
    units = info.observation_units
    return [name for name, size in sizes.items() if size == _SIZE and "quaternion" in units.get(name, "").lower()]


def find_command_ranges(info: EnvInfo, slices: Mapping[str, slice]) -> dict[str, list[tuple[float, float]]]:
    """Return the range of each element of the observations that hold what a person may command.

    They are those called `command`, with all commands, and those after which their elements are called: `goal` for
    `goal_x`, `goal_y` and `goal_z`.
    """
    found = {}
    for name in slices.keys() - info.observation_terms.keys():
        commands = [
            ends for key, ends in info.command_ranges.items() if name == "command" or key.startswith(f"{name}_")
        ]
        if commands and len(commands) == slices[name].stop - slices[name].start:
            found[name] = commands
    return found


Fault = tuple[str, float, float]  # kind and name of the observation, value and limit


class SensorChecks:
    """Checks the numbers of successive observations: finite, in range, not too old, not frozen."""

    def __init__(
        self,
        limits: Limits,
        layout: Layout,
        control_dt: float | None,
        info: EnvInfo,
        measured: MeasuredPositions | None = None,
    ) -> None:
        for name in limits.sensors:
            check_name(name, layout.columns, "limits: sensors: no observation", RecipeError, listed="Known")
        self._layout = layout
        self.oldest = math.inf if control_dt is None else limits.max_age_periods * control_dt
        self.low, self.high = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        self.frozen: list[tuple[str, slice, int]] = []
        self._defaults: dict[str, str] = {}  # ranges by the name of the observation, for people
        for name, ranges in find_command_ranges(info, layout.columns).items():
            low, high = np.array(ranges).T
            slack = _ROUNDING * (high - low)  # float32 rounds the ends, too
            self.low[layout.columns[name]], self.high[layout.columns[name]] = low - slack, high + slack
            self._defaults[name] = ", ".join(f"{least:g} to {most:g}" for least, most in ranges)
        joints = info.joints
        if measured is not None and joints is not None and joints.low and joints.high:
            # One range more to each side: no joint gets there, but one that is measured in degrees does.
            low, high = np.array(joints.low), np.array(joints.high)
            width = np.where(low < high, high - low, np.inf)  # model files write a missing limit as 0
            ends = np.array([measured.write(low - width), measured.write(high + width)])
            self.low[measured.part], self.high[measured.part] = ends.min(axis=0), ends.max(axis=0)
            positions = self._name(measured.part.start).partition("[")[0]
            self._defaults[positions] = "the joints' range and as much again to each side, so that degrees are a fault"
        for name, sensor in limits.sensors.items():
            part = layout.columns[name]
            if sensor.range is not None:
                self.low[part], self.high[part] = sensor.range
                self._defaults.pop(name, None)
            if sensor.frozen_s is not None:
                if control_dt is None:
                    raise RecipeError(
                        f"limits: sensors.{name}.frozen_s: this policy has no control_dt; write control_dt: SECONDS"
                    )
                self.frozen.append((name, part, max(2, round(min(sensor.frozen_s / control_dt, 1e9)))))
        quaternions = find_quaternions(info, layout.columns)
        self.quaternions = [layout.columns[name] for name in quaternions]
        self._norms = dict.fromkeys(quaternions, "norm 0.9 to 1.1")
        self._all_finite = b"\x01" * layout.size
        self.has_range = bool(np.isfinite(self.low).any())
        self.reset()

    def describe_defaults(self) -> list[str]:
        """Return a line for each range that no limits file has given."""
        return [f"{name}: {text}" for some in (self._defaults, self._norms) for name, text in some.items()]

    def reset(self) -> None:
        """Begin an episode."""
        self._last: Array | None = None
        self._same = [0] * len(self.frozen)

    def check(self, values: Array, age_s: float) -> Fault | None:
        """Return a fault of an observation's numbers; None if there is none. `age_s` is its age [s]."""
        fault: Fault | None = None
        # Comparing bytes takes a tenth of the time of `all()`.
        if np.isfinite(values).tobytes() != self._all_finite:
            index = int(np.argmin(np.isfinite(values)))
            fault = (f"{self._name(index)} not finite", float(values[index]), math.inf)
        elif self.has_range and (outside := self._find_outside(values)) is not None:
            value, low, high = (float(array[outside]) for array in (values, self.low, self.high))
            fault = (f"{self._name(outside)} out of range", value, low if value < low else high)
        elif self.quaternions and (odd := self._find_no_unit(values)) is not None:
            fault = odd
        elif not abs(age_s) <= self.oldest:  # from the future: the clocks differ, so its age is unknown
            fault = ("observation too old", age_s, self.oldest)
        if self.frozen:
            fault = self._check_frozen(values) or fault
        return fault

    def _find_outside(self, values: Array) -> int | None:
        if np.minimum(np.maximum(values, self.low), self.high).tobytes() == values.tobytes():
            return None
        outside = (values < self.low) | (values > self.high)
        return int(outside.argmax()) if outside.any() else None  # zeros may differ by their sign

    def _find_no_unit(self, values: Array) -> Fault | None:
        for part in self.quaternions:
            x, y, z, w = values[part].tolist()
            if not UNIT_SQUARES[0] <= (square := x * x + y * y + z * z + w * w) <= UNIT_SQUARES[1]:
                end = UNIT_SQUARES[square > 1.0]
                name = self._name(part.start).partition("[")[0]
                return f"{name} out of range", math.sqrt(square), math.sqrt(end)
        return None

    def _check_frozen(self, values: Array) -> Fault | None:
        fault: Fault | None = None
        for number, (name, part, steps) in enumerate(self.frozen):
            same = self._last is not None and bool((values[part] == self._last[part]).all())
            self._same[number] = self._same[number] + 1 if same else 0
            if self._same[number] >= steps:
                fault = (f"{name} frozen", float(self._same[number]), float(steps))
        self._last = values.copy()  # an environment may write the next ones into the same memory
        return fault

    def _name(self, index: int) -> str:
        name = self._layout.find_name(index)
        part = self._layout.columns[name]
        return name if part.stop - part.start == 1 else f"{name}[{index - part.start}]"
