"""RL117: angle that wraps."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import read_rows, select_leaves
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL117",
    "angle that wraps",
    Severity.INFO,
    meaning="""
        An element of the observation is an angle that jumps by 2 pi. For a network the two ends of the range
        are far apart although the robot is at the same place.
    """,
    fix="Observe the sine and the cosine of the angle instead.",
)

FEWEST_JUMPS = 2
NEAR_TURN, SMALL_TURN = 1.0, 1.5  # a step of an angle is 2 pi +- NEAR_TURN, or small [rad]


@judges_records(RULE, *WITH_SEARCH)
def _find_wrapped_angles(records: Records) -> Iterator[RuleFinding]:
    for index, _ in select_leaves(records):
        rows = read_rows(records, index)
        changes = np.concatenate([np.abs(np.diff(series.rows, axis=0)) for _, series in records.series(index)])
        jumps = np.abs(changes - 2 * np.pi) < NEAR_TURN
        is_angle = (np.abs(rows) <= 2 * np.pi).all(axis=0) & (jumps | (changes < SMALL_TURN)).all(axis=0)
        for column in np.flatnonzero(is_angle & (jumps.sum(axis=0) >= FEWEST_JUMPS))[:1]:
            name, count = records.require_built().element(index, int(column)), int(jumps[:, column].sum())
            message = f"{name} jumps by 2 pi in {count} of {len(changes)} steps: an angle that wraps"
            yield RuleFinding(RULE, message, {"element": name, "expected": "sin and cos"})
