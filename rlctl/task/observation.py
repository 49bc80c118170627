"""Checks what a task observes at every step, and assembles the observations of n worlds: a flat Box, or a Dict."""

import dataclasses
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import RecipeError, TaskError, check_name, did_you_mean
from rlctl.task.history import TermHistory
from rlctl.task.layout import Layout
from rlctl.task.returned import WrongRow
from rlctl.task.task import TaskDefinition
from rlctl.task.terms import Term

Observation = NDArray[np.float32] | dict[str, NDArray[Any]]
"""Rows of shape (k, size), or a dict of arrays of shape (k, ...)."""

ROUNDING = 1e-4
"""A value this far outside its bounds is clipped as a rounding error; farther outside it is an error of the task."""


@dataclasses.dataclass(frozen=True)
class Observing:
    """What a policy observes of a task; without names, all that the task's `observe` returns."""

    names: Sequence[str] = ()
    """Names of what `observe` or `privileged` returns, and of cameras."""
    history: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Numbers of last values by name, which replace the task's own."""

    def list_names(self, task: str, observed: Mapping[str, Any], others: Iterable[str]) -> list[str]:
        """Return the names in the order of the task; raises `RecipeError` for a name that it does not have.

        `others`, of cameras and of what is privileged, are observed only if they are named.
        """
        known = list(dict.fromkeys([*observed, *others]))
        for name in self.names:
            check_name(name, known, f"observe: {task} has no observation", RecipeError, listed="It has")
        return [name for name in known if name in self.names] or list(observed)

    def find_frames(self, task: TaskDefinition, names: Sequence[str]) -> dict[str, int]:
        """Return the numbers of last values by name; raises `RecipeError` for a name that is not observed."""
        what = f"observation_history: {type(task).__name__} has no observation"
        for name in self.history:
            check_name(name, names, what if not self.names else "observation_history: not in observe:", RecipeError)
        frames = {**task.observation_history, **self.history}
        return {name: count for name, count in frames.items() if name in names and count > 1}


def check_names(task: TaskDefinition, observed: Mapping[str, Any]) -> None:
    """Raise `TaskError` if a task declares something of an observation that it does not have."""
    quantities = [name for term in task.observation_terms.values() for name in term.inputs]
    for what, names, known in (
        ("bounds or units", task.observation_bounds, observed),
        ("a term", task.observation_terms, observed),
        ("a history", task.observation_history, observed),
        ("bounds or units", task.observation_units, [*observed, *quantities]),
    ):
        if unknown := [name for name in names if name not in known]:
            raise TaskError(
                f"{type(task).__name__}: {what} for {unknown[0]!r}, which is not observed."
                f"{did_you_mean(unknown[0], known)}"
            )


class View:
    """What one policy sees of n worlds: some observations by name, with histories, as rows of a flat Box or a Dict."""

    def __init__(
        self,
        task: TaskDefinition,
        worlds: int,
        observing: Observing,
        observed: Mapping[str, Any],
        privileged: Mapping[str, Any],
    ) -> None:
        """`observed` and `privileged` are examples of what the task's methods return for one world."""
        self._name = type(task).__name__
        if not isinstance(privileged, dict):
            privileged = {}
        pictures = {name: np.zeros(camera.shape, np.uint8) for name, camera in task.cameras.items()}
        names = observing.list_names(self._name, observed, [*pictures, *privileged])
        self.cameras = [name for name in names if name in pictures]
        """The cameras that it sees by."""
        self.privileged = [name for name in names if name not in observed and name not in pictures]
        """What it sees of what `privileged` returns."""
        self._is_dict = task.observation_layout == "dict" or bool(self.cameras)
        examples = {**privileged, **pictures, **observed}
        first = {name: examples[name] for name in names}
        self.frames = observing.find_frames(task, names)
        """The number of last values of those that are histories."""
        for name in self.frames:
            if len(shape := np.shape(first[name])) > 1:
                raise TaskError(
                    f"{self._name}: observation_history of {name!r}, of shape {shape}: only vectors have one"
                )
        self._names = names if observing.names or pictures else None
        self._history = TermHistory(worlds, self.frames, task.history_start) if self.frames else None
        self._single_shapes = {name: np.shape(value) for name, value in first.items()}
        self._shapes = {name: self._find_shape(name, value) for name, value in first.items()}
        self.layout = Layout({name: math.prod(shape) for name, shape in self._shapes.items()}, self.frames)
        if empty := [name for name, size in self.layout.sizes.items() if size == 0]:
            raise TaskError(f"{self._name}: observation {empty[0]!r} is empty: check the slice in observe")
        self._bounds = {name: bounds for name, bounds in task.observation_bounds.items() if name in first}
        # Camera pictures stay bytes, as libraries expect images.
        self._pictures = {
            name for name, value in first.items() if self._is_dict and np.asarray(value).dtype == np.uint8
        }
        self.space = self._make_space()
        self._zeros = np.zeros(worlds * self.layout.size, np.float32)

    @property
    def sizes(self) -> dict[str, int]:
        """Elements per name, in the order of the flat observation."""
        return self.layout.sizes

    def _find_shape(self, name: str, first: Any) -> tuple[int, ...]:
        if name in self.frames:
            return (self.frames[name] * int(np.size(first)),)
        return np.shape(first)

    def _make_space(self) -> Any:
        parts: dict[str, Any] = {}
        for name, shape in self._shapes.items():
            if name in self._pictures:
                parts[name] = spaces.Box(0, 255, shape, np.uint8)
            else:
                low, high = self._bounds.get(name, (-math.inf, math.inf))
                parts[name] = spaces.Box(low, high, shape, np.float32)
        if self._is_dict:
            return spaces.Dict(parts)
        lows = [part.low.ravel() for part in parts.values()]
        highs = [part.high.ravel() for part in parts.values()]
        return spaces.Box(np.concatenate(lows), np.concatenate(highs), dtype=np.float32)

    def make_rows(self, count: int) -> Any:
        """Return an array of shape (count, size), or a dict of such, for observations."""
        if self._is_dict:
            return {name: np.zeros((count, *part.shape), part.dtype) for name, part in self.space.spaces.items()}
        return np.zeros((count, self.layout.size), np.float32)

    def begin(self, worlds: Any) -> None:
        """Begin the episodes of some worlds."""
        if self._history is not None:
            self._history.begin(worlds)

    def assemble(self, parts: Mapping[str, Any], worlds: Any) -> Observation:
        """Return the observations of some worlds, from parts of shape (k, ...); raises `WrongRow`."""
        if self._names is not None:
            parts = {name: parts[name] for name in self._names if name in parts}
        if self._history is not None:
            if not all(name in parts for name in self.frames):
                raise self._shape_mismatch(parts)
            parts = self._history.add(parts, worlds)
        if self._is_dict:
            return self._assemble_dict(parts)
        values = [part if part.ndim == 2 else part.reshape(len(part), -1) for part in parts.values()]
        try:
            rows: NDArray[np.float32] = np.concatenate(values, axis=1, dtype=np.float32)
        except ValueError:
            raise self._shape_mismatch(parts) from None
        if rows.shape[1] != self.layout.size:
            raise self._shape_mismatch(parts)
        if not is_finite(rows, self._zeros):
            raise self._not_finite(parts, rows)
        if self._bounds:
            rows = self._clip_rounding(rows, self.space.low, self.space.high, parts)
        return rows

    def _assemble_dict(self, parts: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        observed: dict[str, Any] = {}
        for name, value in parts.items():
            observed[name] = np.array(value, np.uint8 if name in self._pictures else np.float32)
        if {name: value.shape[1:] for name, value in observed.items()} != self._shapes:
            raise self._shape_mismatch(parts)
        for value in observed.values():
            if not math.isfinite(value.sum()):
                raise self._not_finite(parts, None)
        for name, (low, high) in self._bounds.items():
            observed[name] = self._clip_rounding(observed[name], low, high, parts)
        return observed

    def _clip_rounding(self, values: NDArray[np.float32], low: Any, high: Any, parts: Mapping[str, Any]) -> Any:
        clipped = np.minimum(np.maximum(values, low), high)
        if np.abs(clipped - values).max(initial=0.0) > ROUNDING:
            raise self._out_of_bounds(parts)
        return clipped

    def _shape_mismatch(self, parts: Mapping[str, Any]) -> WrongRow:
        now = {name: np.shape(value)[1:] for name, value in parts.items()}
        known = self._single_shapes
        if all(name in now and now[name] == self._shapes[name] for name in self._shapes):
            known = self._shapes
        names = [name for name in {**known, **now} if known.get(name) != now.get(name)]
        name = names[0] if names else "order"
        return WrongRow(
            f"observation {name!r} has shape {now.get(name)} at step {{}}, {known.get(name)} at the first observation"
        )

    def _not_finite(self, parts: Mapping[str, Any], rows: Any) -> WrongRow:
        for name, value in parts.items():
            bad = ~np.isfinite(value).reshape(len(value), -1).all(axis=1)
            if bad.any():
                row = int(bad.argmax())
                return WrongRow(f"observation {name!r} is not finite at step {{}}: {value[row]}", row)
        row = 0 if rows is None else int((~np.isfinite(rows)).any(axis=1).argmax())
        return WrongRow("observation overflows float32 at step {}", row)

    def _out_of_bounds(self, parts: Mapping[str, Any]) -> WrongRow:
        for name, (low, high) in self._bounds.items():
            values = np.asarray(parts[name], np.float64).reshape(len(parts[name]), -1)
            beyond = np.maximum(low - values, values - high)
            if beyond.max() > ROUNDING:
                row, element = np.unravel_index(beyond.argmax(), beyond.shape)
                return WrongRow(
                    f"observation {name!r} is {values[row, element]:g} at step {{}}, "
                    f"outside its bounds [{low:g}, {high:g}]",
                    int(row),
                )
        return WrongRow("observation outside its bounds at step {}")


class TeacherSight:
    """What a teacher sees of worlds that a student plays: noise and delay only where its own events `disturb`.

    A policy acts best on what it was trained with.
    """

    def __init__(self, view: View, worlds: int, disturbed: Collection[str]) -> None:
        self.view, self.disturbed = view, disturbed
        self.seen: Any = view.make_rows(worlds)
        """Its observation of the present step of each world: an array of shape (worlds, size), or a dict of such."""

    def look(self, exact: Mapping[str, Any], disturbed: Mapping[str, Any], worlds: Any) -> None:
        """Observe; `exact` has everything without noise and delay, `disturbed` what the student's events change."""
        parts = {name: disturbed[name] if name in self.disturbed else value for name, value in exact.items()}
        now = self.view.assemble(parts, worlds)
        if isinstance(now, dict):
            for name, rows in now.items():
                self.seen[name][worlds] = rows
        else:
            self.seen[worlds] = now


def is_finite(values: NDArray[Any], zeros: NDArray[Any]) -> bool:
    """Return whether all values are finite; `zeros` has at least as many. A third of the time of NumPy's `isfinite`."""
    flat = values.ravel()
    return bool(flat.dot(zeros[: len(flat)]) == 0)  # 0 times any other value is NaN


def compute_terms(name: str, terms: Mapping[str, Term], observed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a task observes, with its terms computed; raises `TaskError` where quantities do not fit a term."""
    parts = dict(observed)
    for key, term in terms.items():
        if key in parts:  # a missing one is an error of the observation's shape
            try:
                parts[key] = term(parts[key])
            except (ValueError, TypeError) as error:
                raise TaskError(f"{name}: observation {key!r} does not fit its term {term}: {error}") from None
    return parts
