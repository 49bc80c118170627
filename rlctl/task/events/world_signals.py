"""Noise and delay of n worlds; each world has the numbers of its own generator, whatever the other worlds are."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rlctl.task.events.event import Drawn, ObservationParts, Range, Signal
from rlctl.task.layout import Layout
from rlctl.task.world_index import WorldIndex

Array = NDArray[np.float64]

_BLOCK = 64
"""Number of steps whose random numbers are drawn together; a generator gives the same numbers one step at a time."""
_MOST_NUMBERS = 4096  # in a block, for pictures


class WorldSignal(Protocol):
    """Changes rows of `size` values of n worlds; `largest` has the highest value of each range of its event."""

    def __init__(self, worlds: int, size: int, largest: Mapping[str, float]) -> None: ...

    def begin(self, world: int, rng: np.random.Generator, first: Array, **values: Any) -> Drawn:
        """Begin the episode of a world, whose first values have the shape (size,); return the drawn values."""

    def __call__(self, values: Array, worlds: WorldIndex) -> Array:
        """Return the values of some worlds with noise or delay, shape (k, size)."""


class WorldNoise:
    """Normal noise on every value at every step."""

    def __init__(self, worlds: int, size: int, largest: Mapping[str, float]) -> None:
        self._block = max(1, min(_BLOCK, _MOST_NUMBERS // max(size, 1)))
        self._std = np.zeros((worlds, 1))
        self._rngs: dict[int, np.random.Generator] = {}
        self._numbers = np.zeros((worlds, self._block, size))
        self._next = np.zeros(worlds, np.int64)

    def begin(self, world: int, rng: np.random.Generator, first: Array, **values: Any) -> Drawn:
        """Draw the standard deviation of the episode from the range `std`."""
        self._std[world] = rng.uniform(*values["std"])
        self._rngs[world] = rng
        self._next[world] = self._block
        return {"std": float(self._std[world, 0])}

    def __call__(self, values: Array, worlds: WorldIndex) -> Array:
        """Add the numbers of the worlds' next step."""
        for world in worlds[self._next[worlds] == self._block].tolist():
            self._numbers[world] = self._rngs[world].standard_normal(self._numbers.shape[1:])
            self._next[world] = 0
        numbers = self._numbers[worlds, self._next[worlds]]
        self._next[worlds] += 1
        noisy: Array = values + self._std[worlds] * numbers
        return noisy


class WorldDelay:
    """Values of some control steps before; the last ones of each world are in a ring."""

    def __init__(self, worlds: int, size: int, largest: Mapping[str, float]) -> None:
        self._past = np.zeros((int(largest["steps"]) + 1, worlds, size))
        self._steps, self._place = np.zeros(worlds, np.int64), np.zeros(worlds, np.int64)

    def begin(self, world: int, rng: np.random.Generator, first: Array, **values: Any) -> Drawn:
        """Draw the number of steps of the episode from the range `steps`; until then the first values are the past."""
        low, high = values["steps"]
        self._steps[world] = rng.integers(int(low), int(high) + 1)
        self._past[:, world] = first
        return {"steps": float(self._steps[world])}

    def __call__(self, values: Array, worlds: WorldIndex) -> Array:
        """Return the values of earlier steps."""
        place = (self._place[worlds] + 1) % len(self._past)
        self._place[worlds] = place
        self._past[place, worlds] = values
        late: Array = self._past[(place - self._steps[worlds]) % len(self._past), worlds]
        return late


WORLD_SIGNALS: dict[Callable[..., Any], type[WorldSignal]] = {}
"""The functions of events that act on many worlds at once, and how; all others are called per world."""


def in_one_world(
    signal: type[WorldSignal], rng: np.random.Generator, first: ObservationParts, **ranges: Range
) -> tuple[Drawn, Signal]:
    """Start a signal for one world, as the function of an event does; authors may call it in functions of their own."""
    layout = Layout({name: int(np.size(value)) for name, value in first.items()})
    world = np.zeros(1, np.int64)
    rows = signal(1, layout.size, {name: high for name, (_, high) in ranges.items()})

    def join(parts: ObservationParts) -> Array:
        return np.concatenate([np.asarray(parts[name], np.float64) for name in first], axis=None)

    def change(parts: ObservationParts) -> ObservationParts:
        changed = layout.split(rows(join(parts)[None], world)[0])
        return {name: values.reshape(np.shape(parts[name])) for name, values in changed.items()}

    drawn = rows.begin(0, rng, join(first), **ranges)
    return drawn, change
