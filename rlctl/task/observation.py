"""Checks what a task observes at every step, and assembles the environment's observation: a flat Box, or a Dict."""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import RecipeError, TaskError, check_name, did_you_mean
from rlctl.task.history import TermHistory
from rlctl.task.task import Task
from rlctl.task.terms import Term

Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]

ROUNDING = 1e-4
"""A value this far outside its bounds is clipped as a rounding error; farther outside it is an error of the task."""


@dataclasses.dataclass(frozen=True)
class Observing:
    """What a policy observes of a task; without names, all that the task's `observe` returns."""

    names: Sequence[str] = ()
    """Names of what `observe` or `privileged` returns."""
    history: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Numbers of last values by name, which replace the task's own."""

    def list_names(self, task: str, observed: Mapping[str, Any], privileged: Mapping[str, Any]) -> list[str]:
        """Return the names in the order of the task; raises `RecipeError` for a name that it does not have."""
        known = [*observed, *(name for name in privileged if name not in observed)]
        for name in self.names:
            check_name(name, known, f"observe: {task} has no observation", RecipeError, listed="It has")
        return [name for name in known if name in self.names] or list(observed)

    def find_frames(self, task: Task, names: Sequence[str]) -> dict[str, int]:
        """Return the numbers of last values by name; raises `RecipeError` for a name that is not observed."""
        what = f"observation_history: {type(task).__name__} has no observation"
        for name in self.history:
            check_name(name, names, what if not self.names else "observation_history: not in observe:", RecipeError)
        frames = {**task.observation_history, **self.history}
        return {name: count for name, count in frames.items() if name in names and count > 1}


def check_names(task: Task, observed: Mapping[str, Any]) -> None:
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


class ObservationFormat:
    """The space of observations, and their assembly; `first` is an example, by name.

    `frames` has the number of last values of those that are histories.
    """

    def __init__(self, task: Task, first: Mapping[str, Any], frames: Mapping[str, int]) -> None:
        self._task = task
        self._name = type(task).__name__
        self._bounds = {name: bounds for name, bounds in task.observation_bounds.items() if name in first}
        self.frames = dict(frames)
        self.frame_sizes = {name: int(np.size(value)) for name, value in first.items()}
        """Elements per name of one step, without histories."""
        for name in frames:
            if len(shape := np.shape(first[name])) > 1:
                raise TaskError(
                    f"{self._name}: observation_history of {name!r}, of shape {shape}: only vectors have one"
                )
        self._shapes = {
            name: (frames[name] * int(np.size(value)),) if name in frames else np.shape(value)
            for name, value in first.items()
        }
        # Camera pictures stay bytes, as libraries expect images.
        self._dtypes: dict[str, Any] = {
            name: np.uint8 if np.asarray(value).dtype == np.uint8 else np.float32 for name, value in first.items()
        }
        self.sizes = {name: math.prod(shape) for name, shape in self._shapes.items()}
        """Elements per name, in the order of the flat observation."""
        if empty := [name for name, size in self.sizes.items() if size == 0]:
            raise TaskError(f"{self._name}: observation {empty[0]!r} is empty: check the slice in observe")
        self.space = self._make_space()
        self._zeros = np.zeros(self.space.shape or (), np.float32)

    def _make_space(self) -> Any:
        parts: dict[str, Any] = {}
        for name, shape in self._shapes.items():
            is_picture = self._dtypes[name] is np.uint8 and self._task.observation_layout == "dict"
            low, high = (0, 255) if is_picture else self._bounds.get(name, (-math.inf, math.inf))
            parts[name] = spaces.Box(low, high, shape, np.uint8 if is_picture else np.float32)
        if self._task.observation_layout == "dict":
            return spaces.Dict(parts)
        lows, highs = ([getattr(part, end).ravel() for part in parts.values()] for end in ("low", "high"))
        return spaces.Box(np.concatenate(lows), np.concatenate(highs), dtype=np.float32)

    def assemble(self, parts: Mapping[str, Any], step: int) -> Observation:
        """Return the observation made of its parts; raises `TaskError`, with the step, if it is not in the space."""
        if self._task.observation_layout == "dict":
            observed: dict[str, Any] = {name: np.array(value, self._dtypes.get(name)) for name, value in parts.items()}
            if {name: value.shape for name, value in observed.items()} != self._shapes:
                raise self._shape_mismatch(parts, step)
            if not all(math.isfinite(value.sum()) for value in observed.values()):
                raise self._not_finite(parts, step)
            for name, (low, high) in self._bounds.items():
                observed[name] = self._clip_rounding(observed[name], low, high, parts, step)
            return observed
        try:
            observation = np.concatenate([*parts.values()], axis=None, dtype=np.float32)
        except ValueError:
            raise self._shape_mismatch(parts, step) from None
        if observation.shape != self.space.shape:
            raise self._shape_mismatch(parts, step)
        if not math.isfinite(observation.dot(self._zeros)):  # 0, unless an element is not finite
            raise self._not_finite(parts, step)
        if self._bounds:
            observation = self._clip_rounding(observation, self.space.low, self.space.high, parts, step)
        return observation

    def _clip_rounding(
        self, values: NDArray[np.float32], low: Any, high: Any, parts: Mapping[str, Any], step: int
    ) -> Any:
        clipped = np.minimum(np.maximum(values, low), high)
        if np.abs(clipped - values).max(initial=0.0) > ROUNDING:
            raise self._out_of_bounds(parts, step)
        return clipped

    def _shape_mismatch(self, parts: Mapping[str, Any], step: int) -> TaskError:
        now = {name: np.shape(value) for name, value in parts.items()}
        names = [name for name in {**self._shapes, **now} if self._shapes.get(name) != now.get(name)]
        name = names[0] if names else "order"
        return TaskError(
            f"{self._name}: observation {name!r} has shape {now.get(name)} at step {step}, "
            f"{self._shapes.get(name)} at the first observation"
        )

    def _not_finite(self, parts: Mapping[str, Any], step: int) -> TaskError:
        for name, value in parts.items():
            if not np.isfinite(value).all():
                return TaskError(f"{self._name}: observation {name!r} is not finite at step {step}: {value}")
        return TaskError(f"{self._name}: observation overflows float32 at step {step}")

    def _out_of_bounds(self, parts: Mapping[str, Any], step: int) -> TaskError:
        for name, (low, high) in self._bounds.items():
            worst = max(np.ravel(parts[name]).tolist(), key=lambda value: max(low - value, value - high))
            if max(low - worst, worst - high) > ROUNDING:
                return TaskError(
                    f"{self._name}: observation {name!r} is {worst:g} at step {step}, "
                    f"outside its bounds [{low:g}, {high:g}]"
                )
        return TaskError(f"{self._name}: observation outside its bounds at step {step}")


class View:
    """What one policy sees of a task in one world: some observations by name, with histories."""

    def __init__(
        self, task: Task, observing: Observing, observed: Mapping[str, Any], privileged: Mapping[str, Any]
    ) -> None:
        """`observed` and `privileged` are examples of what the task's methods return."""
        privileged = privileged if isinstance(privileged, dict) else {}
        names = observing.list_names(type(task).__name__, observed, privileged)
        self._names = names if observing.names else None
        self.privileged = [name for name in names if name not in observed]
        """What it sees of what `privileged` returns."""
        examples = {**privileged, **observed}
        frames = observing.find_frames(task, names)
        self.format = ObservationFormat(task, {name: examples[name] for name in names}, frames)
        self._history = TermHistory(self.format.frames, task.history_start)

    def begin(self) -> None:
        """Begin an episode."""
        self._history.begin()

    def assemble(self, parts: Mapping[str, Any], step: int) -> Observation:
        """Return the observation of a step; raises `TaskError` if it is not in the space."""
        chosen = parts if self._names is None else {name: parts[name] for name in self._names if name in parts}
        return self.format.assemble(self._history.add(chosen), step)


class TeacherSight:
    """What a teacher sees of a task that a student plays: noise and delay only where its own events `disturb`.

    A policy acts best on what it was trained with.
    """

    def __init__(self, view: View, disturbed: Collection[str]) -> None:
        self.view, self.disturbed = view, disturbed
        self.seen: Observation | None = None
        """Its observation of the present step."""

    def look(self, exact: Mapping[str, Any], disturbed: Mapping[str, Any], step: int) -> None:
        """Observe; `exact` has everything without noise and delay, `disturbed` what the student's events change."""
        parts = {name: disturbed[name] if name in self.disturbed else value for name, value in exact.items()}
        self.seen = self.view.assemble(parts, step)


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
