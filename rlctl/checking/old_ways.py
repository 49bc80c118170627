"""Vectors of the observation that are the way from a place, in an attribute, of the step before."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.worlds import Array

SIZES = (3, 2)  # of a place
MOST_PLACES, MOST_BLOCKS = 12, 40
LEAST_MOTION = 1e-3  # standard deviation of what moves
OLD_FITS = 1e-3  # part of the variance that the place of the step before leaves at most
PRESENT_FAILS = 10.0  # how many times more the present one leaves
FEWEST_STEPS = 60
FEWEST_OF_EPISODE = 15
EQUAL = 1e-12


def find_old_ways(log: AttributeLog, parts: Sequence[object]) -> Iterator[tuple[slice, str]]:
    """Yield vectors, as elements of the observation, and the attribute that has the place: the length of the vector
    follows where the place was one step before, and not where it is; without those where another vector follows the
    present place. `parts` says of each element which array it belongs to.

    The other end of the way is constant in an episode. A squared length is |p|^2 - 2 p.g + |g|^2 then, whatever frame
    the vector is in.
    """
    steps = np.flatnonzero(log.is_step)
    if len(steps) < FEWEST_STEPS:
        return
    for size in SIZES:
        firsts = range(min(MOST_BLOCKS, len(parts)) - size + 1)
        blocks = [first for first in firsts if len(set(parts[first : first + size])) == 1]
        if not blocks:
            continue
        squares = np.stack([np.square(log.observed[:, b : b + size]).sum(axis=1) for b in blocks], axis=1)
        for name, place in _list_places(log, size):
            terms = np.column_stack([np.ones(len(place)), place, np.square(place).sum(axis=1)])
            present, before = (
                _measure_rests(squares, terms, steps, looks, log.episodes) for looks in (steps, steps - 1)
            )
            is_old = (before < OLD_FITS) & (present > PRESENT_FAILS * np.maximum(before, EQUAL))
            if is_old.any() and present.min() > OLD_FITS:
                first = blocks[int(np.where(is_old, before, np.inf).argmin())]
                yield slice(first, first + size), name


def _list_places(log: AttributeLog, size: int) -> list[tuple[str, Array]]:
    """Return the attributes that are vectors, without those that another one was a step before. Shape (looks, size)."""
    owners: dict[str, list[int]] = {}
    for column, name in enumerate(log.names):
        owners.setdefault(name.rpartition("[")[0], []).append(column)
    found = {name: log.values[:, columns] for name, columns in owners.items() if name and len(columns) == size}
    moving = {name: rows for name, rows in found.items() if rows.std(axis=0).min() > LEAST_MOTION}
    kept = [(name, rows) for name, rows in moving.items() if not _is_old(log, rows, moving.values())]
    return kept[:MOST_PLACES]


def _is_old(log: AttributeLog, rows: Array, others: Collection[Array]) -> bool:
    steps = np.flatnonzero(log.is_step)
    return any(np.abs(rows[steps] - other[steps - 1]).max() < EQUAL for other in others if other is not rows)


def _measure_rests(
    observed: Array, terms: Array, steps: NDArray[np.intp], looks: NDArray[np.intp], episodes: NDArray[np.int64]
) -> Array:
    """Return which part of the variance of each column observed after steps is left by terms at looks, with other
    weights in each episode. Shape (columns,)."""
    left, whole = np.zeros(observed.shape[1]), np.zeros(observed.shape[1])
    for episode in np.unique(episodes):
        rows = np.flatnonzero(episodes[steps] == episode)
        if len(rows) < FEWEST_OF_EPISODE:
            continue
        wanted = observed[steps[rows]]
        size = np.maximum(np.abs(terms[looks[rows]]).max(axis=0), EQUAL)
        basis = terms[looks[rows]] / size
        weights = np.linalg.lstsq(basis, wanted, rcond=1e-9)[0]
        left += np.square(wanted - basis @ weights).sum(axis=0)
        whole += np.square(wanted - wanted.mean(axis=0)).sum(axis=0)
    return np.asarray(left / np.maximum(whole, EQUAL))
