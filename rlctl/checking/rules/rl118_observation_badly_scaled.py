"""RL118: observation badly scaled."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import read_rows, select_leaves
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL118",
    "observation badly scaled",
    Severity.INFO,
    meaning="""
        Elements of the observation are larger than 100 as a root mean square over all steps; rare peaks above it do
        no harm. Networks expect inputs around 1 and learn slowly from larger ones. Often the unit is millimetres or
        degrees by mistake.
    """,
    fix="""
        Use metres and radians, divide by a usual value, or normalise observations (normalize: in the recipe,
        VecNormalize).
    """,
)

LARGE_SIZE = 100.0  # root mean square; networks expect inputs around 1


@judges_records(RULE, *WITH_SEARCH)
def _find_large_elements(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    large: dict[str, float] = {}
    for index, _ in select_leaves(records):
        sizes = np.sqrt(np.mean(np.square(np.nan_to_num(read_rows(records, index))), axis=0))
        large |= {built.element(index, int(i)): float(sizes[i]) for i in np.flatnonzero(sizes > LARGE_SIZE)}
    if large and not records.normalizes("observation"):
        names = [f"{name} ({size:.3g})" for name, size in sorted(large.items(), key=lambda pair: -pair[1])]
        message = f"elements of the observation are large (root mean square): {list_names(names)}"
        evidence = {"value": max(large.values()), "expected": f"up to {LARGE_SIZE:g}", "elements": list(large)[:8]}
        yield RuleFinding(RULE, message, evidence)
