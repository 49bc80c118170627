"""The events that act in one environment: called at their moments, in the order the task declares them."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from rlctl.errors import RlctlError, TaskError
from rlctl.task.events.event import BoundEvent, Drawn, When
from rlctl.task.sim import Sim

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
                check_drawn(event.name, drawn)
                all_drawn[event.name] = drawn
        return all_drawn


def check_drawn(name: str, drawn: Any) -> None:
    """Raise `TaskError` unless the function of an event returned the drawn numbers by name."""
    if not isinstance(drawn, dict) or not all(isinstance(value, int | float) for value in drawn.values()):
        raise TaskError(f"events.{name}: its function must return a dict of the drawn numbers by name, not {drawn!r}")
