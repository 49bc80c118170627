"""What an environment's observations and actions are: names, declared bounds, and the values that were seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.leaves import Leaf, leaf_name
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
    seen: tuple[float, float] | None
    """Smallest and largest value that occurred; None where none was recorded."""


def observation_rows(records: Records) -> list[Row]:
    """Return the parts of the observation, in order."""
    built = records.built
    rows: list[Row] = []
    for index, leaf in enumerate(built.leaves if built else ()):
        if built is not None and leaf.low is not None and leaf.high is not None:
            seen = _seen([t.observations[index].values for t in records.alone if index in t.observations], leaf)
            for name, part in _parts(built, leaf):
                rows.append(_row(name, np.ravel(leaf.low)[part], np.ravel(leaf.high)[part], seen, part))
    return rows


def action_rows(records: Records) -> list[Row]:
    """Return the parts of the action, in order; what was tried is not what will be, so nothing is said as seen."""
    leaves = records.built.action_leaves if records.built else []
    return [
        _row(
            leaf_name(leaf).replace("observation", "action"), np.ravel(leaf.low), np.ravel(leaf.high), None, slice(None)
        )
        for leaf in leaves
        if leaf.low is not None and leaf.high is not None
    ]


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
        yield leaf_name(leaf), slice(0, size)


def _seen(values: list[NDArray[np.generic]], leaf: Leaf) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    rows = [each.reshape(len(each), -1).astype(np.float64) for each in values if each.size]
    if not rows:
        return None
    with np.errstate(invalid="ignore"):
        return np.min([r.min(axis=0) for r in rows], axis=0), np.max([r.max(axis=0) for r in rows], axis=0)


def _row(
    name: str,
    low: NDArray[np.generic],
    high: NDArray[np.generic],
    seen: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
    part: slice,
) -> Row:
    values = None if seen is None else (float(seen[0][part].min()), float(seen[1][part].max()))
    return Row(name, low.size, float(low.astype(np.float64).min()), float(high.astype(np.float64).max()), values)
