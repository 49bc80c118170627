"""Recorded observations as the rules about them read them."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.records import CheckedEpisode, Form, Records
from rlctl.checking.rule import NotJudged
from rlctl.environments.leaves import Leaf

FEWEST_ROWS, FEWEST_SEEDS = 50, 3


def name_moment(step: int) -> str:
    """Return when an observation was made, in words; 0 is the one of `reset`."""
    return "from reset" if step == 0 else f"at step {step}"


def list_forms(records: Records) -> Iterator[tuple[int, Leaf, CheckedEpisode, Form]]:
    """Yield the types that observations had: the place of the leaf, the leaf, the episode and the type."""
    leaves = records.require_built().leaves
    for episode, form in sorted(records.forms("observation"), key=lambda pair: pair[1].leaf or 0):
        index = form.leaf or 0
        if leaves[index].supported:
            yield index, leaves[index], episode, form


def read_rows(records: Records, index: int) -> NDArray[np.float64]:
    """Return all observations of a leaf, shape (n, elements); raises `NotJudged` for too few."""
    recorded = records.series(index)
    if not recorded:
        raise NotJudged("no observation of the declared shape was recorded")
    rows = np.concatenate([series.rows for _, series in recorded])
    seeds = len({trajectory.seed for trajectory, _ in recorded})
    if len(rows) < FEWEST_ROWS or seeds < FEWEST_SEEDS:
        raise NotJudged(f"only {len(rows)} observations with {seeds} seeds were recorded")
    return rows


def select_leaves(records: Records, kinds: str = "f") -> Iterator[tuple[int, Leaf]]:
    """Yield place and leaf of the arrays of some kinds of numbers that are no images."""
    for index, leaf in enumerate(records.require_built().leaves):
        smallest = min(leaf.shape[0], leaf.shape[-1]) if leaf.shape else 0
        is_image = len(leaf.shape) == 3 and (leaf.dtype == "uint8" or smallest in (1, 3, 4))
        if leaf.supported and 0 not in leaf.shape and np.dtype(leaf.dtype).kind in kinds and not is_image:
            yield index, leaf
