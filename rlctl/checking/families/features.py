"""RL110, RL117 and RL118: numbers in an observation that say nothing, jump, or are large."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.families.rewards import WITH_SEARCH
from rlctl.checking.leaves import Leaf
from rlctl.checking.records import Records
from rlctl.checking.rules import NotJudged, RuleFinding, Severity, check, list_names

Numbers = NDArray[np.float64]

FEWEST_ROWS = 50
FEWEST_SEEDS = 3
MOST_NAMED = 8
NEAR_TURN, SMALL_TURN = 1.0, 1.5  # a step of an angle is 2 pi +- NEAR_TURN, or small [rad]
FEWEST_JUMPS = 2
LARGE_SIZE = 100.0  # root mean square; networks expect inputs around 1


def _rows(records: Records, index: int) -> Numbers:
    recorded = records.series(index)
    if not recorded:
        raise NotJudged("no observation of the declared shape was recorded")
    rows = np.concatenate([series.values for _, series in recorded])
    seeds = len({trajectory.seed for trajectory, _ in recorded})
    if len(rows) < FEWEST_ROWS or seeds < FEWEST_SEEDS:
        raise NotJudged(f"only {len(rows)} observations with {seeds} seeds were recorded")
    return rows.reshape(len(rows), -1)


def _leaves(records: Records, kinds: str = "f") -> Iterator[tuple[int, Leaf]]:
    """Yield index and leaf of the observation's arrays of some kinds of numbers, images left out."""
    for index, leaf in enumerate(records.require_built().leaves):
        smallest = min(leaf.shape[0], leaf.shape[-1]) if leaf.shape else 0
        is_image = len(leaf.shape) == 3 and (leaf.dtype == "uint8" or smallest in (1, 3, 4))
        if leaf.supported and 0 not in leaf.shape and np.dtype(leaf.dtype).kind in kinds and not is_image:
            yield index, leaf


@check("RL110", *WITH_SEARCH, of_absence=True)
def _find_constant_elements(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    names: list[str] = []
    total, has_constant_leaf = 0, False
    for index, leaf in _leaves(records, "biuf"):
        rows = _rows(records, index)
        constant = _constant(rows, leaf)
        total += rows.shape[1]
        has_constant_leaf |= len(constant) == rows.shape[1]
        names += [f"{built.element(index, int(column))} ({float(rows[0, column]):.4g})" for column in constant]
    if names:
        yield RuleFinding(
            "RL110",
            f"{len(names)} of {total} elements of the observation never changed: {list_names(names, MOST_NAMED)}",
            {"value": len(names), "expected": 0, "elements": [name.partition(" (")[0] for name in names[:MOST_NAMED]]},
            Severity.WARNING if has_constant_leaf else Severity.INFO,
        )


def _constant(rows: Numbers, leaf: Leaf) -> NDArray[np.intp]:
    """Return what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return np.zeros(0, np.intp)
    return np.flatnonzero(still & (low < high))


@check("RL117", *WITH_SEARCH)
def _find_wrapped_angles(records: Records) -> Iterator[RuleFinding]:
    for index, _ in _leaves(records):
        rows = _rows(records, index)
        values = [series.values.reshape(len(series.values), -1) for _, series in records.series(index)]
        changes = np.concatenate([np.abs(np.diff(value.astype(np.float64), axis=0)) for value in values])
        jumps = np.abs(changes - 2 * np.pi) < NEAR_TURN
        is_angle = (np.abs(rows) <= 2 * np.pi).all(axis=0) & (jumps | (changes < SMALL_TURN)).all(axis=0)
        for column in np.flatnonzero(is_angle & (jumps.sum(axis=0) >= FEWEST_JUMPS))[:1]:
            name = records.require_built().element(index, int(column))
            count = f"{int(jumps[:, column].sum())} of {len(changes)} steps"
            message = f"{name} jumps by 2 pi in {count}: an angle that wraps"
            yield RuleFinding("RL117", message, {"element": name, "expected": "sin and cos"})


@check("RL118", *WITH_SEARCH)
def _find_large_elements(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    large: dict[str, float] = {}
    for index, _ in _leaves(records):
        sizes = np.sqrt(np.mean(np.square(np.nan_to_num(_rows(records, index).astype(np.float64))), axis=0))
        large |= {built.element(index, int(i)): float(sizes[i]) for i in np.flatnonzero(sizes > LARGE_SIZE)}
    if large and not records.normalizes("observation"):
        names = [f"{name} ({size:.3g})" for name, size in sorted(large.items(), key=lambda pair: -pair[1])]
        message = f"elements of the observation are large (root mean square): {list_names(names, MOST_NAMED)}"
        evidence = {"value": max(large.values()), "expected": f"up to {LARGE_SIZE:g}"}
        yield RuleFinding("RL118", message, {**evidence, "elements": list(large)[:MOST_NAMED]})
