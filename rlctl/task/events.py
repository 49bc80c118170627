"""Named random changes of a world: domain randomisation and pushes."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any, Literal, Protocol

import numpy as np

from rlctl.errors import RecipeError, did_you_mean
from rlctl.task.sim import Sim

Range = tuple[float, float]


class EventFunction(Protocol):
    """Changes the world, always from its nominal values, and returns what it drew."""

    def __call__(self, sim: Sim, rng: np.random.Generator, /, **parameters: Any) -> dict[str, float]: ...


class Event:
    """A change `function(sim, rng, **parameters)` at every `reset`, or each `every_s` seconds at an `interval`.

    Events act when the recipe says so; one that is part of the problem says `enabled=True`.
    """

    def __init__(
        self,
        when: Literal["reset", "interval"],
        function: EventFunction,
        *,
        every_s: float = 1.0,
        enabled: bool = False,
        **parameters: Any,
    ) -> None:
        self.when = when
        self.function = function
        self.every_s = every_s
        self.enabled = enabled
        self.parameters = parameters

    def with_parameters(self, name: str, changes: Mapping[str, Any]) -> Event:
        """Return this event, enabled, with some parameters replaced; `name` is for the error."""
        known = [p.name for p in inspect.signature(self.function).parameters.values()][2:]
        for key in changes:
            if key not in [*known, "every_s"]:
                raise RecipeError(
                    f"events.{name}: no parameter {key!r}.{did_you_mean(key, known)} It has: {', '.join(known)}."
                )
        parameters = {**self.parameters, **changes}
        every_s = float(parameters.pop("every_s", self.every_s))
        return Event(self.when, self.function, every_s=every_s, enabled=True, **parameters)

    def __call__(self, sim: Sim, rng: np.random.Generator) -> dict[str, float]:
        return self.function(sim, rng, **self.parameters)


def scale_mass(sim: Sim, rng: np.random.Generator, *, body: str, factor: Range) -> dict[str, float]:
    """Scale the mass and inertia of every link of `body`, the base included, by one factor."""
    drawn = float(rng.uniform(*factor))
    sim.body(body).scale_mass(drawn)
    return {"factor": drawn}


def set_friction(sim: Sim, rng: np.random.Generator, *, body: str, friction: Range) -> dict[str, float]:
    """Set the lateral friction of every link of `body`."""
    drawn = float(rng.uniform(*friction))
    sim.body(body).set_friction(drawn)
    return {"friction": drawn}


@dataclasses.dataclass(frozen=True)
class EventSettings:
    """What a recipe says of a task's events."""

    randomize: bool = False
    changes: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)

    def apply(self, events: Mapping[str, Event]) -> dict[str, Event]:
        """Return the events that act, by name."""
        for name in self.changes:
            if name not in events:
                raise RecipeError(
                    f"events: this task has no event {name!r}.{did_you_mean(name, events)} "
                    f"It has: {', '.join(events) or 'none'}."
                )
        active = {}
        for name, event in events.items():
            if name in self.changes:
                active[name] = event.with_parameters(name, self.changes[name])
            elif event.enabled or self.randomize:
                active[name] = event
        return active
