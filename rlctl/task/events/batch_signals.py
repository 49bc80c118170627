"""Noise and delay in many worlds at once: the numbers that each world alone would have, bit for bit."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.errors import in_world
from rlctl.task.events.acting import Signals, Streams, start_signal
from rlctl.task.events.changes import delay, noise
from rlctl.task.events.event import BoundEvent, Drawn, Parts, Signal, Widening

Array = NDArray[np.float64]
Worlds = NDArray[np.int64]

_BLOCK = 64
"""Number of steps whose random numbers are drawn together; a generator gives the same numbers one step at a time."""
_ACTION = "action"


class RowsSignal(Protocol):
    """An event on observations or actions of many worlds; `sizes` has the number of elements by name."""

    def __init__(self, event: BoundEvent, worlds: int, sizes: Mapping[str, int]) -> None: ...

    def begin(self, world: int, rng: np.random.Generator, first: Array, level: float) -> Drawn:
        """Begin the episode of a world, whose first values have the shape (elements,); return the drawn values."""

    def __call__(self, values: Array, rows: Worlds) -> Array:
        """Return the values of some worlds with noise or delay, shape (rows, elements)."""


class NoiseRows:
    """`noise` of many worlds, each with the numbers of its own generator."""

    def __init__(self, event: BoundEvent, worlds: int, sizes: Mapping[str, int]) -> None:
        self._event = event
        self._size = sum(sizes.values())
        self._std = np.zeros((worlds, 1))
        self._rngs: dict[int, np.random.Generator] = {}
        self._numbers = np.zeros((worlds, _BLOCK, self._size))
        self._next = np.zeros(worlds, np.int64)

    def begin(self, world: int, rng: np.random.Generator, first: Array, level: float) -> Drawn:
        """Draw the standard deviation of the episode."""
        self._std[world] = rng.uniform(*self._event.read("std", level))
        self._rngs[world] = rng
        self._next[world] = _BLOCK
        return {"std": float(self._std[world, 0])}

    def __call__(self, values: Array, rows: Worlds) -> Array:
        """Add the numbers of the worlds' next step."""
        for world in rows[self._next[rows] == _BLOCK].tolist():
            self._numbers[world] = self._rngs[world].standard_normal((_BLOCK, self._size))
            self._next[world] = 0
        numbers = self._numbers[rows, self._next[rows]]
        self._next[rows] += 1
        noisy: Array = values + self._std[rows] * numbers
        return noisy


class DelayRows:
    """`delay` of many worlds: the last values of each are in a ring."""

    def __init__(self, event: BoundEvent, worlds: int, sizes: Mapping[str, int]) -> None:
        self._event = event
        steps: Widening = event.values["steps"]
        self._past = np.zeros((int(max(steps.start[1], steps.end[1])) + 1, worlds, sum(sizes.values())))
        self._steps, self._place = np.zeros(worlds, np.int64), np.zeros(worlds, np.int64)

    def begin(self, world: int, rng: np.random.Generator, first: Array, level: float) -> Drawn:
        """Draw the number of steps of the episode; until then the first values are the past."""
        low, high = self._event.read("steps", level)
        self._steps[world] = rng.integers(int(low), int(high) + 1)
        self._past[:, world] = first
        return {"steps": float(self._steps[world])}

    def __call__(self, values: Array, rows: Worlds) -> Array:
        """Return the values of earlier steps."""
        self._place[rows] = place = (self._place[rows] + 1) % len(self._past)
        self._past[place, rows] = values
        late: Array = self._past[(place - self._steps[rows]) % len(self._past), rows]
        return late


class OwnRows:
    """An event of a user's own function, which knows one world only."""

    def __init__(self, event: BoundEvent, worlds: int, sizes: Mapping[str, int]) -> None:
        self._event = event
        self._signals: dict[int, Signal] = {}
        self._names, self._ends = list(sizes), np.cumsum([*sizes.values()])[:-1]

    def _split(self, values: Array) -> Parts:
        return dict(zip(self._names, np.split(values.copy(), self._ends), strict=True))

    def begin(self, world: int, rng: np.random.Generator, first: Array, level: float) -> Drawn:
        """Call the function."""
        with in_world(world):
            drawn, self._signals[world] = start_signal(self._event, rng, self._split(first), level)
        return drawn

    def __call__(self, values: Array, rows: Worlds) -> Array:
        """Call the signal of each world."""
        changed = np.empty(values.shape)
        for row, world in enumerate(rows.tolist()):
            with in_world(world):
                parts = self._signals[world](self._split(values[row]))
                np.concatenate([np.ravel(parts[name]) for name in self._names], out=changed[row])
        return changed


_IN_BATCHES: Mapping[Any, type[RowsSignal]] = {noise: NoiseRows, delay: DelayRows}


class BatchSignals:
    """The events on observations and actions of many worlds, in the order of `Signals`; each world has its streams."""

    def __init__(
        self,
        worlds: int,
        events: Mapping[str, BoundEvent],
        first: Parts,
        action_space: spaces.Box,
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        single = Signals(events, first, action_space, bounds)
        self._streams: list[Streams] = [{} for _ in range(worlds)]
        self._levels, self._is_new = np.ones(worlds), np.zeros(worlds, bool)
        self.drawn: list[dict[str, Drawn]] = [{} for _ in range(worlds)]
        """Per world the values drawn for its episode, by event."""
        self._space = action_space
        self._low, self._high = action_space.low.ravel(), action_space.high.ravel()
        self._on_action = [(event.name, _make(event, worlds, {_ACTION: len(self._low)})) for event in single.on_action]
        sizes = {name: int(np.size(value)) for name, value in first.items()}
        ends = dict(zip(sizes, np.cumsum([*sizes.values()]).tolist(), strict=True))
        self._on_observation: list[tuple[str, Any, RowsSignal, list[tuple[slice, tuple[float, float]]]]] = []
        for event in single.on_observation:
            names = single.of[event.name]
            slices = {name: slice(ends[name] - sizes[name], ends[name]) for name in names}
            columns = np.concatenate([np.arange(part.start, part.stop) for part in slices.values()])
            clipped = [(slices[name], single.bounds[name]) for name in names if name in single.bounds]
            signal = _make(event, worlds, {name: sizes[name] for name in names})
            self._on_observation.append((event.name, columns, signal, clipped))

    def begin(self, world: int, streams: Streams, level: float) -> None:
        """Start the episode of a world; each event uses its own random stream."""
        self._streams[world], self._levels[world], self._is_new[world] = streams, level, True
        zero = np.clip(np.zeros(len(self._low)), self._low, self._high)
        for name, signal in self._on_action:
            self.drawn[world][name] = signal.begin(world, streams[name], zero, level)

    def observe(self, values: Array, rows: Worlds) -> Array:
        """Return observations of some worlds, shape (rows, size), with noise and delay; changes `values`."""
        new = np.flatnonzero(self._is_new[rows]).tolist()
        self._is_new[rows] = False
        for name, columns, signal, clipped in self._on_observation:
            exact = values[:, columns]
            for row in new:  # events on observations begin with the first one
                world = int(rows[row])
                stream, level = self._streams[world][name], float(self._levels[world])
                self.drawn[world][name] = signal.begin(world, stream, exact[row], level)
            values[:, columns] = signal(exact, rows)
            for part, bounds in clipped:
                values[:, part] = np.clip(values[:, part], *bounds)
        return values

    def act(self, action: NDArray[Any], rows: Worlds) -> NDArray[Any]:
        """Return the actions that the motors of some worlds get; they stay inside the action space."""
        if not self._on_action:
            return action
        values = action.reshape(len(rows), -1).astype(np.float64)
        for _, signal in self._on_action:
            values = signal(values, rows)
        disturbed: NDArray[Any] = np.clip(values, self._low, self._high).astype(self._space.dtype)
        return disturbed.reshape(action.shape)


def _make(event: BoundEvent, worlds: int, sizes: Mapping[str, int]) -> RowsSignal:
    return _IN_BATCHES.get(event.event.function, OwnRows)(event, worlds, sizes)
