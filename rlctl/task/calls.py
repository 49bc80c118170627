"""Calls the methods of an author's task for n worlds, and checks what they return.

`OneWorldCalls` adds the leading axis to what a `Task` takes and returns; a `BatchTask` has it already.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import TaskError, short_repr
from rlctl.task.batch import BatchTask, WorldRngs, read_rows
from rlctl.task.returned import not_a_number, not_by_name, reward_not_finite, term_mismatch
from rlctl.task.sim import Sim
from rlctl.task.task import Task
from rlctl.task.world_index import WorldIndex

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


ONE_FLAG = {False: np.zeros(1, bool), True: np.ones(1, bool)}
"""A flag of one world as an array that cannot be written."""
for _flag in ONE_FLAG.values():
    _flag.setflags(write=False)


class TaskCalls(Protocol):
    """The methods of a task for n worlds; all arrays have a leading axis."""

    has_success: bool
    has_end: bool
    """Whether episodes may end before the time limit without being terminated."""

    def build(self, sim: Any) -> None:
        """Build the world."""

    def sim_of(self, sim: Any, world: int) -> Sim:
        """Return the simulation of one world, on which events act."""

    def restore(self, sim: Any, worlds: WorldIndex) -> None:
        """Take some worlds back to the state in which they were saved."""

    def reset(self, generators: Sequence[np.random.Generator], worlds: WorldIndex) -> None:
        """Begin the episodes of some worlds."""

    def set_level(self, levels: Array, worlds: WorldIndex) -> None:
        """Set how hard the next episodes of some worlds are."""

    def act(self, action: Any) -> None:
        """Set motor targets, from actions of shape (n, ...)."""

    def observe(self) -> dict[str, Any]:
        """Return the observations or the quantities of terms by name, each of shape (n, ...)."""

    def rewards(self, action: Any, weights: Mapping[str, float]) -> Array:
        """Return the reward and the raw terms in the order of `weights`, shape (n, 1 + terms).

        Weighted terms are added in order, so that the last bits do not depend on the number of worlds. A `Task`'s
        term that is not a number, or its reward that is not finite, raises `WrongRow`.
        """

    def is_terminated(self) -> Flags:
        """Return where episodes end, shape (n,)."""

    def is_truncated(self) -> Flags:
        """Return where episodes end although their state is as good as any, shape (n,)."""

    def next_level(self, world: int) -> float | None:
        """Return the level of the episode after one that has ended; None if the task does not choose it."""

    def is_success(self) -> Flags:
        """Return where the goal is reached, shape (n,)."""

    def privileged(self) -> Any:
        """Return what only a critic sees by name, each of shape (n, ...)."""

    def markers(self) -> dict[str, Any]:
        """Return points to draw by name, each of shape (n, 3)."""

    def leave_others(self, sim: Any, worlds: WorldIndex) -> contextlib.AbstractContextManager[None]:
        """Take back what the task's methods, which see all worlds, change in the others than `worlds`."""

    def check_kept(self, when: str) -> None:
        """Raise `TaskError` if an attribute that is kept per world has another shape than declared."""


class OneWorldCalls:
    """A `Task` for one world."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.name = type(task).__name__
        self.has_success = type(task).is_success is not Task.is_success
        self.has_end = False
        self._is_discrete = isinstance(task.action_space, spaces.Discrete)

    def build(self, sim: Any) -> None:
        """Build the world."""
        self.task.sim = sim
        self.task.build(sim)

    def sim_of(self, sim: Any, world: int) -> Sim:
        """Return the simulation."""
        one: Sim = sim
        return one

    def restore(self, sim: Any, worlds: WorldIndex) -> None:
        """Take the world back to the state in which it was saved."""
        sim.restore()

    def reset(self, generators: Sequence[np.random.Generator], worlds: WorldIndex) -> None:
        """Begin the episode."""
        self.task.reset(generators[0])

    def set_level(self, levels: Array, worlds: WorldIndex) -> None:
        """Set how hard the next episode is."""
        self.task.level = float(levels[0])

    def act(self, action: Any) -> None:
        """Set motor targets."""
        self.task.act(self._take(action))

    def _take(self, action: Any) -> Any:
        return int(action[0]) if self._is_discrete else action[0]

    def observe(self) -> dict[str, Any]:
        """Return the observations with a leading axis."""
        observed = self.task.observe()
        if not isinstance(observed, dict) or not observed:
            raise not_by_name(self.name, "observe", observed)
        terms = self.task.observation_terms
        rows: dict[str, Any] = {}
        for name, value in observed.items():
            if name not in terms:
                rows[name] = value[None] if value.__class__ is np.ndarray else np.asarray(value)[None]
            elif isinstance(value, tuple):
                rows[name] = tuple([_quantity_row(quantity) for quantity in value])
            else:
                rows[name] = _quantity_row(value)
        return rows

    def rewards(self, action: Any, weights: Mapping[str, float]) -> Array:
        """Return the reward and the raw terms, shape (1, 1 + terms)."""
        raw: Any = self.task.rewards(self._take(action))
        if not isinstance(raw, dict):
            raise not_by_name(self.name, "rewards", raw)
        if raw.keys() != weights.keys():
            raise term_mismatch(self.name, raw, weights)
        row, reward = [0.0], 0.0
        try:
            for name, weight in weights.items():
                term = float(raw[name])
                row.append(term)
                reward += weight * term
        except (TypeError, ValueError):
            raise not_a_number(raw) from None
        if not math.isfinite(reward):
            weighted = {name: weights[name] * term for name, term in zip(weights, row[1:], strict=True)}
            raise reward_not_finite(weighted, reward)
        row[0] = reward
        return np.array([row])

    def is_terminated(self) -> Flags:
        """Return whether the episode ends, shape (1,)."""
        return self._read_flag("is_terminated", self.task.is_terminated())

    def is_truncated(self) -> Flags:
        """Return False: only the time limit truncates the episodes of a `Task`."""
        return ONE_FLAG[False]

    def next_level(self, world: int) -> float | None:
        """Return None: the level follows success."""
        return None

    def is_success(self) -> Flags:
        """Return whether the goal is reached, shape (1,)."""
        return self._read_flag("is_success", self.task.is_success())

    def _read_flag(self, method: str, flag: Any) -> Flags:
        if flag is False or flag is True:
            return ONE_FLAG[flag]
        try:
            is_flag = flag in (False, True)
        except ValueError:  # an array
            is_flag = False
        if not is_flag:
            raise TaskError(f"{self.name}: {method}() returned {short_repr(flag)}, not True or False")
        return ONE_FLAG[bool(flag)]

    def privileged(self) -> Any:
        """Return what only a critic sees with a leading axis."""
        parts = self.task.privileged()
        if not isinstance(parts, dict):
            return parts
        return {name: np.asarray(value)[None] for name, value in parts.items()}

    def markers(self) -> dict[str, Any]:
        """Return points to draw, each of shape (1, 3)."""
        return {name: np.asarray(value)[None] for name, value in self.task.markers().items()}

    def leave_others(self, sim: Any, worlds: WorldIndex) -> contextlib.AbstractContextManager[None]:
        """Do nothing: there are no other worlds."""
        return contextlib.nullcontext()

    def check_kept(self, when: str) -> None:
        """Do nothing: a `Task` keeps what it likes."""


def _quantity_row(value: Any) -> Any:
    """Return a quantity that a term is computed from, which may be a number, as an array of shape (1, size)."""
    array = np.asarray(value)
    return array[None] if array.ndim else array.reshape(1, 1)


class ManyWorldCalls:
    """A `BatchTask`, whose methods must return a row per world."""

    def __init__(self, task: BatchTask, worlds: int) -> None:
        self.task, self._worlds = task, worlds
        self.name = type(task).__name__
        self.has_success = type(task).is_success is not BatchTask.is_success
        self.has_end = type(task).is_truncated is not BatchTask.is_truncated
        self._sizes: dict[str, int | None] = {}  # elements of each part of the first observation; None of quantities

    def build(self, sim: Any) -> None:
        """Build the worlds."""
        self.task.prepare(sim, self._worlds)

    def sim_of(self, sim: Any, world: int) -> Sim:
        """Return the simulation of one world."""
        one: Sim = sim.one(world)
        return one

    def restore(self, sim: Any, worlds: WorldIndex) -> None:
        """Take some worlds back to the state in which they were saved."""
        sim.restore(worlds)

    def reset(self, generators: Sequence[np.random.Generator], worlds: WorldIndex) -> None:
        """Begin the episodes of some worlds."""
        self.task.clear_kept(worlds)
        self.task.reset(WorldRngs(generators), worlds)

    def set_level(self, levels: Array, worlds: WorldIndex) -> None:
        """Set how hard the next episodes of some worlds are."""
        self.task.level[worlds] = levels

    def act(self, action: Any) -> None:
        """Set motor targets."""
        self.task.act(action)

    def observe(self) -> dict[str, Any]:
        """Return the observations, with a row per world."""
        parts = self.task.observe()
        if not isinstance(parts, dict) or not parts:
            raise not_by_name(self.name, "observe", parts)
        if self._sizes and list(parts) != list(self._sizes):
            raise TaskError(f"{self.name}: observe() returned {short_repr(list(parts))}, at first {list(self._sizes)}")
        read = {name: self._read_part("observe", name, value, self._sizes.get(name)) for name, value in parts.items()}
        if not self._sizes:
            self._sizes = {name: None if isinstance(value, tuple) else value.shape[1] for name, value in read.items()}
        return read

    def _read_part(self, method: str, name: str, value: Any, size: int | None = None) -> Any:
        if isinstance(value, tuple):  # the quantities of a term
            return tuple(self._read_part(method, name, quantity) for quantity in value)
        return read_rows(self.name, f"{method}()[{name!r}]", value, (self._worlds, size), np.float64)

    def rewards(self, action: Any, weights: Mapping[str, float]) -> Array:
        """Return the reward and the raw terms, shape (n, 1 + terms)."""
        raw: Any = self.task.rewards(action)
        if not isinstance(raw, dict):
            raise not_by_name(self.name, "rewards", raw)
        if raw.keys() != weights.keys():
            raise term_mismatch(self.name, raw, weights)
        rows = np.zeros((self._worlds, 1 + len(weights)))
        for index, (name, weight) in enumerate(weights.items(), start=1):
            where = f"rewards()[{name!r}]"
            term = read_rows(self.name, where, raw[name], (self._worlds,), np.float64)
            rows[:, index] = term
            rows[:, 0] += weight * term
        return rows

    def is_terminated(self) -> Flags:
        """Return where episodes end, shape (n,)."""
        return read_rows(self.name, "is_terminated()", self.task.is_terminated(), (self._worlds,), bool)

    def is_truncated(self) -> Flags:
        """Return where episodes end although their state is as good as any, shape (n,)."""
        return read_rows(self.name, "is_truncated()", self.task.is_truncated(), (self._worlds,), bool)

    def next_level(self, world: int) -> float | None:
        """Return the level of the episode after one that has ended, within [0, 1]; None: it follows success."""
        levels = self.task.next_levels()
        if levels is None:
            return None
        rows = read_rows(self.name, "next_levels()", levels, (self._worlds,), np.float64)
        return round(min(max(float(rows[world]), 0.0), 1.0), 9)

    def is_success(self) -> Flags:
        """Return where the goal is reached, shape (n,)."""
        return read_rows(self.name, "is_success()", self.task.is_success(), (self._worlds,), bool)

    def privileged(self) -> Any:
        """Return what only a critic sees, with a row per world."""
        parts = self.task.privileged()
        if not isinstance(parts, dict):
            return parts
        return {name: self._read_part("privileged", name, value) for name, value in parts.items()}

    def markers(self) -> dict[str, Any]:
        """Return points to draw, each of shape (n, 3)."""
        markers = self.task.markers()
        return {name: self._read_part("markers", name, value) for name, value in markers.items()}

    @contextlib.contextmanager
    def leave_others(self, sim: Any, worlds: WorldIndex) -> Iterator[None]:
        """Take back what the task's methods, which see all worlds, change in the others than `worlds`."""
        if len(worlds) == self._worlds:
            yield
            return
        others = np.setdiff1d(np.arange(self._worlds), worlds)
        kept = {name: getattr(self.task, name)[others] for name in self.task.per_world}
        try:
            with sim.keep(others):
                yield
        finally:
            for name, values in kept.items():
                getattr(self.task, name)[others] = values

    def check_kept(self, when: str) -> None:
        """Raise `TaskError` if an attribute of `per_world` has another shape than declared."""
        for name, shape in self.task.per_world.items():
            value = getattr(self.task, name)
            if np.shape(value) != (self._worlds, *shape):
                raise TaskError(
                    f"{self.name}: after {when} self.{name} has shape {np.shape(value)}; per_world declares "
                    f"{(self._worlds, *shape)}"
                )
