"""The events that act in one environment: called at their moments, in the order the task declares them."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.errors import RlctlError, TaskError, check_name
from rlctl.task.events.event import BoundEvent, Drawn, Parts, Signal, When
from rlctl.task.sim import Sim

_ACTION = "action"

Streams = Mapping[str, np.random.Generator]
"""A random generator for each event, by its name."""


def seed_streams(events: Iterable[str], seed: int) -> Streams:
    """Return the generators of an episode's events.

    An event's random numbers depend only on the seed and its name: an episode starts the same with and without events,
    and a change to one event does not change the draws of the others.
    """
    sequences = {name: np.random.SeedSequence(seed, spawn_key=tuple(name.encode())) for name in events}
    return {name: np.random.default_rng(sequence) for name, sequence in sequences.items()}


class ActingEvents:
    """Calls the events at `reset`, `start` and `interval`; `level` in [0, 1] sets the width of their ranges."""

    def __init__(self, events: Mapping[str, BoundEvent], control_dt: float) -> None:
        self._events: dict[When, list[BoundEvent]] = {"reset": [], "start": [], "interval": []}
        for event in events.values():
            self._events.get(event.event.when, []).append(event)
        self.periods = [max(1, round(event.event.every_s / control_dt)) for event in self._events["interval"]]

    def run(self, when: When, sim: Sim, streams: Streams, level: float) -> dict[str, Drawn]:
        """Call the events at a moment; return the values that they drew, by name."""
        return {event.name: event(sim, streams[event.name], level) for event in self._events[when]}

    def run_due(self, step: int, sim: Sim, streams: Streams, level: float) -> dict[str, Drawn]:
        """Call the interval events whose period ends at `step`."""
        due = zip(self._events["interval"], self.periods, strict=True)
        return {event.name: event(sim, streams[event.name], level) for event, period in due if step % period == 0}

    def try_once(self, moments: Iterable[When], sim: Sim) -> dict[str, Drawn]:
        """Call events once, to find mistakes: a name that the world does not have, or a result of the wrong type.

        Return the values that they drew, by name.
        """
        all_drawn: dict[str, Drawn] = {}
        for when in moments:
            for event in self._events[when]:
                try:
                    drawn = event(sim, np.random.default_rng(0), 1.0)
                except RlctlError as error:
                    raise event.error(f"events.{event.name}: {error}") from None
                _check_drawn(event.name, drawn)
                all_drawn[event.name] = drawn
        return all_drawn


class Signals:
    """Noise and delay on observations and actions; noisy observations stay inside their `bounds`."""

    def __init__(
        self,
        events: Mapping[str, BoundEvent],
        first: Parts,
        action_space: spaces.Space[Any],
        bounds: Mapping[str, tuple[float, float]],
    ) -> None:
        self.on_observation = [event for event in events.values() if event.event.when == "observation"]
        self.on_action = [event for event in events.values() if event.event.when == "action"]
        self.of = {event.name: _find_observed(event, first) for event in self.on_observation}
        self._first = first
        self._space = action_space
        for event in self.on_action:
            if not isinstance(action_space, spaces.Box):
                raise event.error(
                    f"events.{event.name}: only actions in a Box can have noise or delay, not {action_space}."
                )
        pictures = {name: (0, 255) for name, value in first.items() if np.asarray(value).dtype == np.uint8}
        self.bounds = {**pictures, **bounds}
        self._observation_signals: dict[str, Signal] = {}  # by event
        self._action_signals: list[Signal] = []
        self.drawn: dict[str, Drawn] = {}
        """Values drawn for this episode, by event."""

    def begin(self, streams: Streams, level: float) -> None:
        """Start an episode; each event uses its own random stream."""
        self.drawn = {}
        self._streams, self._level = streams, level
        self._observation_signals = {}  # they begin with the first observation
        if self.on_action:
            low, high = self._space.low, self._space.high  # type: ignore[attr-defined]
            zero = {_ACTION: np.clip(np.zeros_like(low), low, high)}
            self._action_signals = [self._start(event, zero) for event in self.on_action]

    def try_once(self) -> None:
        """Begin every signal once, to find mistakes."""
        self.begin(defaultdict(lambda: np.random.default_rng(0)), 1.0)
        self.observe(self._first)

    def _start(self, event: BoundEvent, first: Parts) -> Signal:
        self.drawn[event.name], signal = start_signal(event, self._streams[event.name], first, self._level)
        return signal

    def observe(self, parts: Parts) -> Parts:
        """Return an observation with noise and delay, as the policy sees it."""
        for event in self.on_observation:
            observed = {name: parts[name] for name in self.of[event.name]}
            if event.name not in self._observation_signals:
                self._observation_signals[event.name] = self._start(event, observed)
            changed = dict(self._observation_signals[event.name](observed))
            for name in observed:
                if name in self.bounds:
                    changed[name] = np.clip(changed[name], *self.bounds[name])
            parts = {**parts, **changed}
        return parts

    def act(self, action: Any) -> Any:
        """Return an action with noise and delay, as the motors get it; it stays inside the action space."""
        if not self._action_signals:
            return action
        parts: Parts = {_ACTION: np.asarray(action, np.float64)}
        for signal in self._action_signals:
            parts = signal(parts)
        low, high = self._space.low, self._space.high  # type: ignore[attr-defined]
        return np.clip(parts[_ACTION], low, high).astype(self._space.dtype)


def start_signal(event: BoundEvent, rng: np.random.Generator, first: Parts, level: float) -> tuple[Drawn, Signal]:
    """Call the function of an event on observations or actions; raises `TaskError` for a result of the wrong type."""
    result = event(rng, first, level)
    if not (isinstance(result, tuple) and len(result) == 2 and callable(result[1])):
        raise TaskError(f"events.{event.name}: its function must return the drawn values and a signal, not {result!r}")
    drawn, signal = result
    _check_drawn(event.name, drawn)
    return drawn, signal


def _find_observed(event: BoundEvent, first: Parts) -> list[str]:
    names = [event.event.of] if isinstance(event.event.of, str) else list(event.event.of)
    for name in names:
        check_name(name, first, f"events.{event.name}: no observation", event.error, listed="There is")
    return names or list(first)


def _check_drawn(name: str, drawn: Any) -> None:
    if not isinstance(drawn, dict) or not all(isinstance(value, int | float) for value in drawn.values()):
        raise TaskError(f"events.{name}: its function must return a dict of the drawn numbers by name, not {drawn!r}")
