"""What an environment's observations and actions are: names, declared bounds, and the values that were observed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.leaves import Leaf, name_leaf
from rlctl.check_env.messages import Built
from rlctl.check_env.records import Records

ELEMENTS_SHOWN = 8
"""So many numbers without names get a row each; more of them share one."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A part of an observation or an action that has a name."""

    name: str
    size: int
    low: float
    """The lowest declared bound of its numbers."""
    high: float
    observed: tuple[float, float] | None = None
    """Smallest and largest value that occurred; None where none was recorded."""


def observation_rows(records: Records) -> list[Row]:
    """Return the parts of the observation, in order."""
    built, rows = records.built, []
    for index, leaf in enumerate(built.leaves if built else ()):
        if built is not None and leaf.supported:
            values = [each.observations[index].values for each in records.alone if index in each.observations]
            flat = [each.reshape(len(each), -1).astype(np.float64) for each in values if each.size]
            rows += [_row(name, leaf, part, flat) for name, part in _parts(built, leaf)]
    return rows


def action_rows(records: Records) -> list[Row]:
    """Return the parts of the action, in order, without the values that were played: a learner plays others."""
    leaves = records.built.action_leaves if records.built else []
    named = [(name_leaf(leaf, "action"), leaf) for leaf in leaves if leaf.supported]
    return [_row(name, leaf, slice(None), []) for name, leaf in named]


def _parts(built: Built, leaf: Leaf) -> Iterator[tuple[str, slice]]:
    size = int(np.prod(leaf.shape))
    if len(built.leaves) == 1 and sum(built.names.values()) == size:
        start = 0
        for name, length in built.names.items():
            yield name, slice(start, start + length)
            start += length
    elif not leaf.path and leaf.shape and size <= ELEMENTS_SHOWN:
        for i in range(size):
            yield built.element(0, i), slice(i, i + 1)
    else:
        yield name_leaf(leaf), slice(0, size)


def _row(name: str, leaf: Leaf, part: slice, values: list[NDArray[np.float64]]) -> Row:
    low, high = (np.ravel(np.asarray(bound, np.float64))[part] for bound in (leaf.low, leaf.high))
    with np.errstate(invalid="ignore"):
        smallest, largest = ([float(function(each[:, part])) for each in values] for function in (np.min, np.max))
    observed = (float(np.min(smallest)), float(np.max(largest))) if values else None
    return Row(name, low.size, float(low.min()), float(high.max()), observed)
