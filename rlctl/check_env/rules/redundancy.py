"""RL1: numbers in an observation that tell nothing, tell the same, or are of quite different size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.evidence import Built, Evidence, Trajectory
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.leaves import Leaf
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import built, lived
from rlctl.check_env.rules.tried import WITH_SEARCH

WARNING, INFO = Severity.WARNING, Severity.INFO

Numbers = NDArray[np.float64]

FEWEST_ROWS = 50
FEWEST_SEEDS = 3
MOST_ROWS = 1_000
"""Observations that are compared element by element: more would only cost time."""
MOST_ELEMENTS = 1_500
"""A larger array is no list of measurements, and its correlations would take seconds."""
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


def _rows(evidence: Evidence, index: int) -> Numbers:
    """Return the observations of one leaf, flat. Shape (n, elements)."""
    lives = [life for life in lived(evidence) if index in life.observations]
    if not lives:
        raise NotJudged("no observation of the declared shape was recorded")
    seeds = len({life.seed for life in lives})
    rows = np.concatenate([_flat(life, index) for life in lives])
    if len(rows) < FEWEST_ROWS or seeds < FEWEST_SEEDS:
        raise NotJudged(f"only {len(rows)} observations with {seeds} seeds were recorded")
    return rows


def _flat(life: Trajectory, index: int) -> NDArray[np.generic]:
    values = life.observations[index].values
    return values.reshape(len(values), -1)


def _some(rows: Numbers) -> Numbers:
    """Return some of the rows, evenly, as double precision."""
    step = max(1, -(-len(rows) // MOST_ROWS))
    return rows[::step].astype(np.float64)


def _vectors(evidence: Evidence) -> Iterator[tuple[int, Leaf]]:
    """Yield the leaves that are lists of measurements: Box, floats, no image, not too large."""
    for index, leaf in enumerate(built(evidence).leaves):
        is_float = leaf.supported and leaf.kind == "Box" and np.dtype(leaf.dtype).kind == "f"
        if is_float and not _is_image(leaf) and 0 < np.prod(leaf.shape) <= MOST_ELEMENTS:
            yield index, leaf


def _is_image(leaf: Leaf) -> bool:
    return len(leaf.shape) == 3 and (leaf.dtype == "uint8" or min(leaf.shape[0], leaf.shape[-1]) in (1, 3, 4))


@rule(
    "RL110",
    "observation element never changes",
    WARNING,
    "Check the index or slice it is read from, and that it is updated in step. If it is constant by nature, leave it "
    "out.",
    needs=WITH_SEARCH,
)
def changes(evidence: Evidence) -> Iterator[Seen]:
    """Elements of the observation have one value for all seeds, episodes and steps, whatever is done. They tell
    nothing; often something else was meant to be there. Normalisation divides such an element by nearly nothing, and
    the first time it does change the network sees a number it never saw."""
    known = built(evidence)
    names: list[str] = []
    first: list[float] = []
    total = 0
    for index, leaf in enumerate(known.leaves):
        if not leaf.supported or leaf.low is None or _is_image(leaf) or not np.prod(leaf.shape):
            continue
        total += int(np.prod(leaf.shape))
        for element, value in _constant(_rows(evidence, index), leaf):
            names.append(known.element(index, element))
            first.append(value)
    if names:
        shown = ", ".join(f"{name} ({value:.4g})" for name, value in list(zip(names, first, strict=True))[:MOST_NAMED])
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        change = "change" if len(names) > 1 else "changes"
        yield Seen(
            f"{len(names)} of {total} elements never {change}: {shown}{more}",
            {"value": len(names), "expected": 0, "elements": names[:MOST_NAMED]},
        )


def _constant(rows: Numbers, leaf: Leaf) -> Iterator[tuple[int, float]]:
    """Yield what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return
    for element in np.flatnonzero(still & (low < high)):
        yield int(element), float(rows[0, element])


@rule(
    "RL111",
    "observation element twice",
    INFO,
    "Leave the copy out, or read what was meant from where it is: an index that is off by one repeats its neighbour.",
    needs=WITH_SEARCH,
)
def copies(evidence: Evidence) -> Iterator[Seen]:
    """An element of an observation equals another one, or is a multiple of it, in everything that was tried. Copies
    cost little; but an exact one is often an index that is off, and then something else is missing."""
    known = built(evidence)
    for index, leaf in _vectors(evidence):
        pairs = _copies(_some(_rows(evidence, index)), float(np.finfo(leaf.dtype).eps))
        for is_exact in (True, False):
            found = [pair for pair in pairs if (pair[2:] == (1.0, 0.0)) is is_exact]
            if found:
                yield _told(known, index, found, is_exact)


def _told(known: Built, index: int, found: Sequence[tuple[int, int, float, float]], is_exact: bool) -> Seen:
    what = "is the same number as" if is_exact else "is a linear function of"
    told = [_equation(known, index, pair, is_exact) for pair in found]
    more = f" and {len(told) - MOST_NAMED} more" if len(told) > MOST_NAMED else ""
    first = f"{known.element(index, found[0][0])} {what} {known.element(index, found[0][1])}"
    others = f" (all: {', '.join(told[:MOST_NAMED])}{more})" if len(told) > 1 or not is_exact else ""
    evidence = {
        "value": len(found),
        "expected": 0,
        "elements": [known.element(index, j) for j, *_ in found[:MOST_NAMED]],
    }
    return Seen(first + others, evidence, WARNING if is_exact else None)


def _equation(known: Built, index: int, pair: tuple[int, int, float, float], is_exact: bool) -> str:
    copy, original, factor, offset = pair
    left, right = known.element(index, copy), known.element(index, original)
    if is_exact:
        return f"{left} = {right}"
    return f"{left} = {factor:.6g} * {right}" + (f" {offset:+.6g}" if offset else "")


def _copies(rows: Numbers, precision: float) -> list[tuple[int, int, float, float]]:
    """Return (element, earlier element, factor, offset) for each element that is a linear function of another."""
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
    size = abs(factor) * np.abs(x).max() + np.abs(y).max() + abs(offset)
    if np.abs(factor * x + offset - y).max() > ROUNDINGS * precision * size:
        return None
    return factor, 0.0 if abs(offset) <= ROUNDINGS * precision * size else offset


@rule(
    "RL112",
    "observation scales far apart",
    WARNING,
    "Normalise observations (normalize: in the recipe, VecNormalize), or bring the elements to a size near 1.",
    needs=WITH_SEARCH,
)
def scales(evidence: Evidence) -> Iterator[Seen]:
    """Elements of one array vary by amounts more than a thousand times apart, and nothing normalises them. A network
    sees only the large ones. A warning where the task's recipe does not normalise, worth knowing where there is no
    recipe."""
    known = built(evidence)
    if evidence.normalizes:
        return
    for index, _ in _vectors(evidence):
        rows = _some(_rows(evidence, index))
        rows = rows[np.isfinite(rows).all(axis=1)]
        deviations = rows.std(axis=0)
        moving = np.flatnonzero(deviations > STILL * np.maximum(1.0, np.abs(rows).max(axis=0, initial=0.0)))
        if len(moving) < 2:
            continue
        small, large = (int(moving[each(deviations[moving])]) for each in (np.argmin, np.argmax))
        if deviations[large] > APART * deviations[small]:
            ratio = float(deviations[large] / deviations[small])
            yield Seen(
                f"{known.element(index, large)} varies by {deviations[large]:.3g}, {known.element(index, small)} by "
                f"{deviations[small]:.3g}: {ratio:.2g} times less, and "
                + ("no recipe says to normalise" if evidence.normalizes is None else "the recipe does not normalise"),
                {
                    "value": ratio,
                    "expected": f"up to {APART:g}",
                    "elements": [known.element(index, each) for each in (large, small)],
                },
                INFO if evidence.normalizes is None else WARNING,
            )
