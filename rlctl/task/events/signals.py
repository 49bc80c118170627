"""`Signals`: noise and delay on the observations and actions of n worlds."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.errors import TaskError, check_name, in_world
from rlctl.task.events.acting import Streams, check_drawn
from rlctl.task.events.event import BoundEvent, Drawn, ObservationParts, Signal, Widening
from rlctl.task.events.world_signals import WORLD_SIGNALS, Array
from rlctl.task.layout import Layout
from rlctl.task.world_index import WorldIndex

_ACTION = "action"


class Signals:
    """The events at `observation` and `action`, in the order of the task; noisy observations stay inside `bounds`.

    `first` is an example of the observations of one world. Each world has its own streams.
    """

    def __init__(
        self,
        worlds: int,
        events: Mapping[str, BoundEvent],
        first: ObservationParts,
        action_space: spaces.Space[Any],
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        self._pictures = {name for name, value in first.items() if np.asarray(value).dtype == np.uint8}
        self.bounds = {**dict.fromkeys(self._pictures, (0.0, 255.0)), **bounds}
        self._space = action_space
        self._zero: Array = np.zeros(0)  # the action before the first one
        self.on_observation: list[_SignalEvent] = []
        self.on_action: list[_SignalEvent] = []
        for event in events.values():
            if event.event.when == "observation":
                observed = {name: np.asarray(first[name]) for name in _find_observed(event, first)}
                self.on_observation.append(_SignalEvent(event, worlds, observed))
            elif event.event.when == "action":
                if not isinstance(action_space, spaces.Box):
                    raise event.error(
                        f"events.{event.name}: only actions in a Box can have noise or delay, not {action_space}."
                    )
                self._zero = np.clip(np.zeros(action_space.shape), action_space.low, action_space.high)
                self.on_action.append(_SignalEvent(event, worlds, {_ACTION: self._zero}))
        self._streams: list[Streams] = [{} for _ in range(worlds)]
        self._levels, self._is_new = np.ones(worlds), np.zeros(worlds, bool)
        self.drawn: list[dict[str, Drawn]] = [{} for _ in range(worlds)]
        """Per world the values drawn for its episode, by event."""

    @property
    def disturbed(self) -> set[str]:
        """Names of the observations that have noise or delay."""
        return {name for acting in self.on_observation for name in acting.names}

    def begin(self, world: int, streams: Streams, level: float) -> None:
        """Start the episode of a world; each event uses its own random stream."""
        self.drawn[world] = {}
        self._streams[world], self._levels[world], self._is_new[world] = streams, level, True
        for acting in self.on_action:
            self._start(acting, world, self._zero.ravel())

    def _start(self, acting: "_SignalEvent", world: int, first: Array) -> None:
        name, level = acting.event.name, float(self._levels[world])
        with in_world(world):
            self.drawn[world][name] = acting.begin(world, self._streams[world][name], first, level)

    def observe(self, parts: ObservationParts, worlds: WorldIndex) -> ObservationParts:
        """Return observations of some worlds, each of shape (k, ...), with noise and delay."""
        if not self.on_observation:
            return parts
        new = np.flatnonzero(self._is_new[worlds]).tolist()
        self._is_new[worlds] = False
        parts = dict(parts)
        for acting in self.on_observation:
            exact = [np.asarray(parts[name], np.float64).reshape(len(worlds), -1) for name in acting.names]
            values = np.concatenate(exact, axis=1)
            for row in new:  # events on observations begin with the first one
                self._start(acting, int(worlds[row]), values[row])
            changed = acting.layout.split(acting.change(values, worlds))
            for name, noisy in changed.items():
                if name in self.bounds:
                    noisy = np.clip(noisy, *self.bounds[name])
                if name in self._pictures:
                    noisy = np.rint(noisy).astype(np.uint8)
                parts[name] = noisy.reshape(np.shape(parts[name]))
        return parts

    def act(self, action: Any, worlds: WorldIndex) -> Any:
        """Return the actions, shape (k, ...), that the motors of some worlds get; they stay inside the action space."""
        if not self.on_action:
            return action
        space: Any = self._space
        values = action.reshape(len(action), -1).astype(np.float64)
        for acting in self.on_action:
            values = acting.change(values, worlds)
        return np.clip(values.reshape(action.shape), space.low, space.high).astype(space.dtype)

    def try_once(self, first: ObservationParts) -> dict[str, Drawn]:
        """Begin every signal once, to find mistakes; return the drawn values by event."""
        acting = [*self.on_observation, *self.on_action]
        self.begin(0, {signal.event.name: np.random.default_rng(0) for signal in acting}, 1.0)
        self.observe({name: np.asarray(value)[None] for name, value in first.items()}, np.zeros(1, np.int64))
        return self.drawn[0]


class _SignalEvent:
    """An event on observations or actions; a user's own function knows one world only and is called per world."""

    def __init__(self, event: BoundEvent, worlds: int, first: ObservationParts) -> None:
        self.event, self.names = event, list(first)
        self.layout = Layout({name: int(np.size(value)) for name, value in first.items()})
        self._shapes = {name: np.shape(value) for name, value in first.items()}
        kind = WORLD_SIGNALS.get(event.event.function)
        self._rows = None
        if kind is not None:
            ranges = {name: value for name, value in event.values.items() if isinstance(value, Widening)}
            largest = {name: max(value.start[1], value.end[1]) for name, value in ranges.items()}
            self._rows = kind(worlds, self.layout.size, largest)
        self._own: dict[int, Signal] = {}

    def begin(self, world: int, rng: np.random.Generator, first: Array, level: float) -> Drawn:
        """Begin the episode of a world, with its first values; return the drawn values."""
        if self._rows is not None:
            values = {name: self.event.read(name, level) for name in self.event.values}
            return self._rows.begin(world, rng, first, **values)
        result = self.event(rng, self._split(first), level)
        if not (isinstance(result, tuple) and len(result) == 2 and callable(result[1])):
            raise TaskError(
                f"events.{self.event.name}: its function must return the drawn values and a signal, not {result!r}"
            )
        drawn, self._own[world] = result
        check_drawn(self.event.name, drawn)
        return drawn

    def change(self, values: Array, worlds: WorldIndex) -> Array:
        """Return the values of some worlds, shape (k, size), with noise or delay."""
        if self._rows is not None:
            return self._rows(values, worlds)
        changed = np.empty(values.shape)
        for row, world in enumerate(worlds.tolist()):
            with in_world(world):
                parts = self._own[world](self._split(values[row]))
                changed[row] = np.concatenate([parts[name] for name in self.names], axis=None)
        return changed

    def _split(self, row: Array) -> ObservationParts:
        parts = self.layout.split(row.copy())
        return {name: values.reshape(self._shapes[name]) for name, values in parts.items()}


def _find_observed(event: BoundEvent, first: ObservationParts) -> list[str]:
    names = [event.event.of] if isinstance(event.event.of, str) else list(event.event.of)
    for name in names:
        check_name(name, first, f"events.{event.name}: no observation", event.error, listed="There is")
    return names or list(first)
