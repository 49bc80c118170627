"""RL106: action space range."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.leaves import Leaf

RULE = Rule(
    "RL106",
    "action space range",
    Severity.ERROR,
    meaning="""
        A continuous action is not in [-1, 1]. Stable-Baselines3 refuses actions without bounds: random and
        squashed actions need a range. If zero is not in the middle (a warning), a policy begins off-centre and
        explores one side only. In another symmetric range, or in [0, 1] (an info), unsquashed policies, whose
        first actions are around 1, explore too little, or only at the bounds.
    """,
    fix="""
        Declare Box(-1, 1, shape, np.float32) and scale to the real range inside step(), so that 0 does little.
    """,
    is_about_space=True,
    allows_old_gym=True,
)

OFF_CENTRE = 0.05  # part of the range that zero may be off its middle, for an info


@judges_records(RULE, "build")
def _find_unusual_actions(records: Records) -> Iterator[RuleFinding]:
    for leaf in records.require_built().action_leaves:
        if leaf.kind == "Box":
            yield from _unusual_actions(leaf)


def _unusual_actions(leaf: Leaf) -> Iterator[RuleFinding]:
    low, high = leaf.flat_bounds
    is_open = ~np.isfinite(low) | ~np.isfinite(high)
    is_thrust = (low == 0) & (high <= 1)  # or a pedal: by nature to one side
    with np.errstate(invalid="ignore"):
        off = np.where(is_open | is_thrust, 0.0, np.abs(low + high) / np.maximum(high - low, 1e-9))
    for wrong, severity, what in (
        (is_open, Severity.ERROR, "have no finite bounds"),
        (off > OFF_CENTRE, Severity.WARNING, "are not symmetric"),
        (off > 0, Severity.INFO, "are not quite symmetric"),
        ((low != -1) | (high != 1), Severity.INFO, "are not in [-1, 1]"),
    ):
        if wrong.any():
            i = int(np.where(wrong, off, -1.0).argmax())  # the farthest off
            message = f"{int(wrong.sum())} of {wrong.size} actions {what}: action[{i}] is in [{low[i]:g}, {high[i]:g}]"
            evidence = {"element": f"action[{i}]", "value": [float(low[i]), float(high[i])], "expected": [-1.0, 1.0]}
            yield RuleFinding(RULE, message, evidence, severity)
            return
    if leaf.dtype != "float32":
        evidence = {"value": leaf.dtype, "expected": "float32"}
        yield RuleFinding(RULE, f"actions are {leaf.dtype}", evidence, Severity.INFO)
