"""What of the observation is the rate of what else."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.transitions import Quantities, Transitions, find_lengths, find_unit_pairs

SAME = 0.99  # correlation of a rate and of what changes by it
USUAL = 0.98  # part of the changes that are looked at
VARIES = 0.2  # standard deviation of a change, part of its root mean square: a clock has a rate of any size
CLOSE = 0.1  # median error of the change, part of its median size


@dataclasses.dataclass(frozen=True)
class Rate:
    """A quantity that changes by its rate times a time."""

    quantity: str
    rate: str
    seconds: float  # [s] if both have units that fit
    size: float  # of the quantity, root mean square


def find_rates(steps: Transitions) -> Iterator[Rate]:
    """Yield what is the rate of what, and for how long: elements, angles, and lengths of consecutive elements."""
    steps = steps.select(~steps.is_last)
    before, after = steps.before, steps.after
    if not before.size:  # every episode has one step, or nothing changes
        return
    pairs = find_unit_pairs(before)
    turns = [np.arctan2(after[:, j], after[:, i]) - np.arctan2(before[:, j], before[:, i]) for i, j in pairs]
    turns = [(turn + np.pi) % (2 * np.pi) - np.pi for turn in turns]
    sizes = np.sqrt(np.mean(np.square(after), axis=0)).tolist()
    names = [*steps.names, *(f"the angle of ({steps.names[i]}, {steps.names[j]})" for i, j in pairs)]
    changes = np.array([*(after - before).T, *turns]).T
    # The rate may be the one before, after, or in the middle.
    rates = [before, after, (before + after) / 2]
    yield from _match(Quantities(changes, names), [*sizes, *[1.0] * len(pairs)], rates, steps.names)
    ways = find_lengths(after - before, steps.names)
    speeds = [find_lengths(rate, steps.names) for rate in rates]
    lengths = np.sqrt(np.mean(np.square(find_lengths(after, steps.names).values), axis=0)).tolist()
    several = [i for i, name in enumerate(ways.names) if name.startswith("length")]
    several_ways = Quantities(ways.values[:, several], [ways.names[i] for i in several])
    sizes = [lengths[i] for i in several]
    yield from _match(several_ways, sizes, [speed.values for speed in speeds], ways.names)


def _match(
    changes: Quantities, sizes: Sequence[float], rates: Sequence[NDArray[np.float64]], names: Sequence[str]
) -> Iterator[Rate]:
    # Angles that wrap, and resets inside of an episode, jump now and then.
    usual = np.abs(changes.values) <= np.quantile(np.abs(changes.values), USUAL, axis=0)
    best = [_correlate(changes.values, rate, usual) for rate in rates]
    for quantity, name in enumerate(changes.names):
        change = changes.values[usual[:, quantity], quantity]
        of_quantity = np.array([correlation[quantity] for correlation in best])
        variant, element = divmod(int(of_quantity.argmax()), of_quantity.shape[1])
        varies = np.std(change) > VARIES * np.sqrt(np.mean(np.square(change)))
        if of_quantity[variant, element] < SAME or names[element] == name or not varies:
            continue
        rate = rates[variant][usual[:, quantity], element]
        seconds = float(change @ rate / (rate @ rate))
        if np.median(np.abs(change - seconds * rate)) < CLOSE * np.median(np.abs(change)):
            yield Rate(name, names[element], abs(seconds), sizes[quantity])


def _correlate(
    changes: NDArray[np.float64], rates: NDArray[np.float64], usual: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return how far usual changes are proportional to rates, 0 to 1. Shapes (n, quantities), (n, elements), and (n,
    quantities)."""
    kept = np.where(usual, changes, 0.0)
    sizes = np.einsum("nq,ne->qe", usual.astype(np.float64), np.square(rates))
    norms = np.linalg.norm(kept, axis=0)[:, None] * np.sqrt(sizes)
    return np.asarray(np.abs(np.einsum("nq,ne->qe", kept, rates)) / np.maximum(norms, 1e-300))
