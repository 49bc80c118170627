"""RL617: success or end is one step late."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.transitions import Quantities, Transitions, collect_transitions, find_differences, find_simple

RULE = Rule(
    "RL617",
    "success or end is one step late",
    Severity.WARNING,
    meaning="""
        A limit of the observation before the step tells exactly in which steps is_success or terminated is
        true; no limit of the observation that the step returns does. So it is judged before the simulation
        advances: episodes last one step too long, and the last state may lie outside the goal.
    """,
    fix="Compute success and termination after the simulation has advanced, from the new state.",
)

FEWEST_SEEDS, MANY_SEEDS = 3, 8  # that events come from: few need one step that leaves the limit again
MOST_LIMITS = 2
JUMP = 1.5  # times nearly all other changes
NOISE = 3.0 / (0.6745 * np.sqrt(6.0))
"""Three standard deviations of white noise, by the median size of its second differences."""


@judges_records(RULE, *rewards.WITH_SEARCH)
def _find_late_success(records: Records) -> Iterator[RuleFinding]:
    rewards.require_readable(records)
    steps = collect_transitions(records)
    ends = steps.terminated & ~steps.success
    for what, is_event, most in (("is_success", steps.success, 1), ("terminated", ends, MOST_LIMITS)):
        if is_event.all() or not steps.names:  # no other step to compare with, or nothing that changes
            continue
        if len(np.unique(steps.seeds[is_event])) >= FEWEST_SEEDS and (late := _find_late_limits(steps, is_event, most)):
            count = f"in all {int(is_event.sum())} steps where it is true, and in no other step"
            where = f"{count}, the observation before the step has {late}"
            message = f"{what} is judged one step late: {where}; no limit of the new observation tells"
            yield RuleFinding(RULE, message, {"element": what, "value": int(is_event.sum())})
            return


@dataclasses.dataclass(frozen=True)
class _Limit:
    """A quantity, times a sign, that is below a limit in some events, and in no other step."""

    column: int
    sign: float
    limit: float
    covered: NDArray[np.bool_]  # Shape (n,)

    def crosses(self, values: NDArray[np.float64], beyond: float = 0.0) -> NDArray[np.bool_]:
        """Say which values are below the limit, and as far below it as is given."""
        return np.asarray(self.sign * values[:, self.column] < self.limit - beyond)


def _find_late_limits(steps: Transitions, is_event: NDArray[np.bool_], most: int) -> str:
    """Return which limits of the state before the step decide; empty if those after it do, or it is not certain."""
    before = _measure(steps.before, steps.names)
    if not (limits := _find_limits(before.values, is_event, most)):
        return ""
    after = _measure(steps.after, steps.names)
    if _find_limits(after.values, is_event, most):
        return ""
    noise = [_measure_noise(after.values[:, limit.column], steps.episodes) for limit in limits]
    now, nearly = (
        np.any([limit.crosses(after.values, side * by) for limit, by in zip(limits, noise, strict=True)], axis=0)
        for side in (1.0, -1.0)
    )
    seeds = len(np.unique(steps.seeds[is_event]))
    missed, is_past = int((now & ~is_event).sum()), bool((is_event & ~nearly).any())
    if missed < min(seeds, MANY_SEEDS) or not (is_past or seeds >= MANY_SEEDS):
        return ""
    for limit in limits:  # a goal that moves when it is reached is not late
        changes = np.abs(after.values[:, limit.column] - before.values[:, limit.column])
        if np.median(changes[is_event]) > JUMP * np.quantile(changes[~is_event], 0.99):
            return ""
    return " or ".join(
        f"{before.names[limit.column]} {'<' if limit.sign > 0 else '>'} {limit.sign * limit.limit:.4g}"
        for limit in limits
    )


def _measure_noise(values: NDArray[np.float64], episodes: NDArray[np.int64]) -> float:
    """Return how far noise takes values that are otherwise smooth."""
    together = episodes[2:] == episodes[:-2]
    seconds = np.abs(values[2:] - 2 * values[1:-1] + values[:-2])[together]
    return float(NOISE * np.median(seconds)) if seconds.size else 0.0


def _measure(rows: NDArray[np.float64], names: Sequence[str]) -> Quantities:
    return find_simple(rows, names) + find_differences(rows, names)


def _find_limits(values: NDArray[np.float64], is_event: NDArray[np.bool_], most: int) -> list[_Limit]:
    """Return a few limits that together are crossed in all events and in no other step; none if there are none.
    Shape of values: (n, quantities)."""
    limits: list[_Limit] = []
    left = is_event
    while left.any() and len(limits) < most:
        best = max(
            (_find_limit(sign, values, is_event, left) for sign in (1.0, -1.0)), key=lambda one: one.covered.sum()
        )
        if not best.covered.any():
            return []
        limits.append(best)
        left = left & ~best.covered
    return [] if left.any() else limits


def _find_limit(
    sign: float, values: NDArray[np.float64], is_event: NDArray[np.bool_], left: NDArray[np.bool_]
) -> _Limit:
    lowest = (sign * values[~is_event]).min(axis=0)
    covered = sign * values[left] < lowest
    column = int(covered.sum(axis=0).argmax())
    rows = left.copy()
    rows[left] = covered[:, column]
    inside = sign * values[rows, column]
    limit = (lowest[column] + inside.max()) / 2 if inside.size else lowest[column]
    return _Limit(column, sign, float(limit), rows)
