"""RL110: observation element never changes."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import read_rows, select_leaves
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.environments.leaves import Leaf

RULE = Rule(
    "RL110",
    "observation element never changes",
    Severity.WARNING,
    meaning="""
        Elements of the observation had one value for all seeds, episodes and steps. They carry no information;
        often the index is wrong. Normalisation divides such an element by nearly nothing: the first time it
        changes, the network gets a huge number. A warning if a whole array of floats is constant, else an info:
        a trained policy may change the element, and masks, maps and targets are often constant. A single whole
        number counts as such an element: it may be a flag, or the number of goals that are left.
    """,
    fix="""
        Check the index or slice it is read from, and that step updates it. If it is constant by nature, leave
        it out.
    """,
)


@judges_records(RULE, *WITH_SEARCH, of_absence=True)
def _find_constant_elements(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    names: list[str] = []
    total, has_constant_leaf = 0, False
    for index, leaf in select_leaves(records, "biuf"):
        rows = read_rows(records, index)
        constant = _constant(rows, leaf)
        total += rows.shape[1]
        is_constant = len(constant) == rows.shape[1]
        has_constant_leaf |= is_constant and np.dtype(leaf.dtype).kind == "f" and not _is_counter(rows)
        names += [f"{built.element(index, int(column))} ({float(rows[0, column]):.4g})" for column in constant]
    if names:
        message = f"{len(names)} of {total} elements of the observation never changed: {list_names(names)}"
        evidence = {"value": len(names), "expected": 0, "elements": [name.partition(" (")[0] for name in names[:8]]}
        is_likely = has_constant_leaf and total > 1  # masks, maps and the single number of a bandit seldom change
        yield RuleFinding(RULE, message, evidence, Severity.WARNING if is_likely else Severity.INFO)


def _is_counter(rows: NDArray[np.float64]) -> bool:
    """Return whether it may count what only a trained policy does, such as goals that are left."""
    return rows.shape[1] == 1 and float(rows[0, 0]).is_integer()


def _constant(rows: NDArray[np.float64], leaf: Leaf) -> NDArray[np.intp]:
    """Return what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = leaf.flat_bounds
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return np.zeros(0, np.intp)
    return np.flatnonzero(still & (low < high))
