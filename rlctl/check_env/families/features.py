"""RL110 to RL112: numbers in an observation that say nothing, say the same, or are of quite different size."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.experiment import check
from rlctl.check_env.finding import Finding, NotJudged, Severity, list_names
from rlctl.check_env.leaves import Leaf
from rlctl.check_env.messages import Built
from rlctl.check_env.records import Records
from rlctl.check_env.rewarded import WITH_SEARCH

Numbers = NDArray[np.float64]
Copy = tuple[int, int, float, float]
"""An element, an earlier one, and factor and offset of the line through it."""

FEWEST_ROWS = 50
FEWEST_SEEDS = 3
MOST_ROWS = 1_000
"""Observations that are compared element by element: more would only cost time."""
MOST_ELEMENTS = 1_500
"""A larger array is not a list of measurements, and its correlations would take seconds."""
MOST_NAMED = 8
CORRELATED = 1e-9
"""A copy's correlation is nearer to 1 than this; which of them really are copies is checked number by number."""
ROUNDINGS = 8
"""Float roundings by which a copy may be off, each of the number type's precision."""
FEWEST_VALUES = 10
"""An element with fewer values (a flag, a counter) may equal another by chance."""
APART = 1_000.0
"""Ratio of scales from which the smaller elements are invisible to a network of usual initial weights."""
STILL = 1e-6
"""Relative to its size: an element that varies less is noise of the simulation."""


def _rows(records: Records, index: int) -> Numbers:
    """Return the observations of one leaf, flat. Shape (n, elements)."""
    episodes = [each for each in records.require_alone() if index in each.observations]
    if not episodes:
        raise NotJudged("no observation of the declared shape was recorded")
    rows = np.concatenate([each.observations[index].values for each in episodes])
    seeds = len({each.seed for each in episodes})
    if len(rows) < FEWEST_ROWS or seeds < FEWEST_SEEDS:
        raise NotJudged(f"only {len(rows)} observations with {seeds} seeds were recorded")
    return rows.reshape(len(rows), -1)


def _vectors(records: Records) -> Iterator[tuple[int, Leaf, Numbers]]:
    """Yield the leaves that are lists of measurements (floats, no image, not too large), with some of their rows."""
    for index, leaf in enumerate(records.require_built().leaves):
        is_float = leaf.supported and leaf.kind == "Box" and np.dtype(leaf.dtype).kind == "f"
        if is_float and not _is_image(leaf) and 0 < np.prod(leaf.shape) <= MOST_ELEMENTS:
            rows = _rows(records, index)
            yield index, leaf, rows[:: max(1, -(-len(rows) // MOST_ROWS))].astype(np.float64)


def _is_image(leaf: Leaf) -> bool:
    return len(leaf.shape) == 3 and (leaf.dtype == "uint8" or min(leaf.shape[0], leaf.shape[-1]) in (1, 3, 4))


@check("RL110", *WITH_SEARCH)
def find_constant_elements(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    names: list[str] = []
    total = 0
    has_constant_leaf = False
    for index, leaf in enumerate(built.leaves):
        size = int(np.prod(leaf.shape))
        if leaf.supported and size and not _is_image(leaf):
            rows = _rows(records, index)
            constant = _constant(rows, leaf)
            total += size
            has_constant_leaf |= len(constant) == size
            names += [f"{built.element(index, int(each))} ({float(rows[0, each]):.4g})" for each in constant]
    if names:
        yield Finding(
            "RL110",
            f"{len(names)} of {total} elements of the observation never changed: {list_names(names, MOST_NAMED)}",
            {"value": len(names), "expected": 0, "elements": [each.partition(" (")[0] for each in names[:MOST_NAMED]]},
            Severity.WARNING if has_constant_leaf else Severity.INFO,
        )


def _constant(rows: Numbers, leaf: Leaf) -> NDArray[np.intp]:
    """Return what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return np.zeros(0, np.intp)
    return np.flatnonzero(still & (low < high))


@check("RL111", *WITH_SEARCH)
def find_copies(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    for index, leaf, rows in _vectors(records):
        if copies := copies_in(rows, float(np.finfo(leaf.dtype).eps)):
            texts = [_equation(built, index, each) for each in copies]
            elements = [built.element(index, each[0]) for each in copies[:MOST_NAMED]]
            yield Finding(
                "RL111", list_names(texts, MOST_NAMED), {"value": len(copies), "expected": 0, "elements": elements}
            )


def _equation(built: Built, index: int, copy: Copy) -> str:
    factor, offset = copy[2:]
    text = f"{built.element(index, copy[0])} = "
    text += f"{factor:.6g} * " if factor != 1 else ""
    return text + built.element(index, copy[1]) + (f" {offset:+.6g}" if offset else "")


def copies_in(rows: Numbers, precision: float) -> list[Copy]:
    """Return the elements (columns) that are a linear function of an earlier one, to the precision of the numbers."""
    elements = _varied(rows, precision)
    if len(elements) < 2:
        return []
    values = rows[:, elements]
    centred = values - values.mean(axis=0)
    unit = centred / np.sqrt((centred**2).sum(axis=0))
    close = np.triu(np.abs(unit.T @ unit) > 1 - CORRELATED, 1)
    found = []
    for j in np.flatnonzero(close.any(axis=0)):
        i = int(close[:, j].argmax())
        line = _line(values[:, i], values[:, j], precision)
        if line is not None:
            found.append((int(elements[j]), int(elements[i]), *line))
    return found


def _varied(rows: Numbers, precision: float) -> NDArray[np.intp]:
    """Return the elements that can be compared: finite, of several values, and more than rounding apart."""
    sizes = np.abs(rows).max(axis=0)
    with np.errstate(invalid="ignore"):
        varied = np.isfinite(sizes) & (rows.std(axis=0) > max(STILL, 1e3 * precision) * sizes)
    elements = np.flatnonzero(varied)
    values = np.sort(rows[:, elements], axis=0)
    distinct: NDArray[np.intp] = elements[1 + (np.diff(values, axis=0) != 0).sum(axis=0) >= FEWEST_VALUES]
    return distinct


def _line(x: Numbers, y: Numbers, precision: float) -> tuple[float, float] | None:
    """Return a and b of y = a x + b, if that holds for all to the precision of the numbers."""
    if np.array_equal(x, y):
        return 1.0, 0.0
    centred = x - x.mean()
    factor = float(centred @ (y - y.mean()) / (centred @ centred))
    offset = float(y.mean() - factor * x.mean())
    tolerance = ROUNDINGS * precision * (abs(factor) * np.abs(x).max() + np.abs(y).max() + abs(offset))
    if np.abs(factor * x + offset - y).max() > tolerance:
        return None
    return factor, 0.0 if abs(offset) <= tolerance else offset


@check("RL112", *WITH_SEARCH)
def find_unequal_scales(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    for index, _, rows in _vectors(records):
        rows = rows[np.isfinite(rows).all(axis=1)]
        deviations = rows.std(axis=0)
        moving = np.flatnonzero(deviations > STILL * np.maximum(1.0, np.abs(rows).max(axis=0, initial=0.0)))
        ordered = moving[np.argsort(deviations[moving])]
        if len(ordered) < 2 or deviations[ordered[-1]] <= APART * deviations[ordered[0]]:
            continue
        if normalizes := records.normalizes():
            return
        large, small = int(ordered[-1]), int(ordered[0])
        ratio, names = float(deviations[large] / deviations[small]), [built.element(index, i) for i in (large, small)]
        recipe = "no recipe says to normalise" if normalizes is None else "the recipe does not normalise"
        yield Finding(
            "RL112",
            f"{names[0]} varies by {deviations[large]:.3g}, {names[1]} by {deviations[small]:.3g}: {ratio:.2g} times "
            f"less, and {recipe}",
            {"value": ratio, "expected": f"up to {APART:g}", "elements": names},
            Severity.INFO if normalizes is None else Severity.WARNING,
        )
