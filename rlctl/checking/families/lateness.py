"""RL616 and RL617: reward, success and end that are computed from the state before the step."""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.families import rewards
from rlctl.checking.families.units import find_rates
from rlctl.checking.records import FIRST_SEED, Records
from rlctl.checking.regression import EXACT, RewardFit, action_terms, fit_observation, fit_terms
from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding, Severity
from rlctl.checking.transitions import Quantities, Transitions, collect_transitions, find_differences, find_simple

MOST_ROWS = 1_200  # steps that rewards are fitted to
FEWEST_ROWS = 300
ROUNDED = 1e4  # to so many parts of 1
CLEARLY = 100.0  # how much worse the observation after the step has to fit than the one before
FEWEST_SEEDS, MANY_SEEDS = 3, 8  # that events come from: few need one step that leaves the limit again
MOST_LIMITS = 2
JUMP = 1.5  # times nearly all other changes
ACTS = "action effects"  # The experiment that knows when the first action changes what


@judges_records("RL616", *rewards.WITH_SEARCH, ACTS)
def _find_late_reward(records: Records) -> Iterator[RuleFinding]:
    rewards.require_rewarded(records)
    if not rewards.reports_success(records.alone):
        raise NotApplicable("no success is reported: a cost of the state and the action chosen in it is a convention")
    from threadpoolctl import threadpool_limits  # takes 20 ms, in each process

    first = records.facts.get(ACTS, {"observation": 0, "reward": 0})
    fit, is_certain = None, bool(records.require_built().uses_pybullet or records.require_built().model)
    # Too few steps, or too many numbers, leave the other way. For so small matrices threads take longer.
    with contextlib.suppress(NotJudged), threadpool_limits(1, "blas"):
        steps = collect_transitions(records)
        fit = _fit_before(sample_ordinary_steps(steps))
        is_certain |= first["reward"] > first["observation"] and any(find_rates(steps))
    if fit is not None:
        of = f" ({', '.join(fit.picked)})" if fit.picked else ""
        exact = f"to within {max(fit.error, 1e-9):.0e} of its spread"
        message = (
            f"the reward is a function of the observation before the step{of}, {exact}, "
            "and not of the observation that the step returns"
        )
        yield RuleFinding("RL616", message, {"value": fit.error})
    elif first["reward"] > first["observation"] and not _are_rounded(records):
        observed, late = first["observation"], first["reward"]
        message = (
            f"the first action changes the observation by step {observed}, but the reward only from step {late} on"
        )
        evidence = {"seed": FIRST_SEED, "value": late, "expected": observed, "step": 1}
        yield RuleFinding("RL616", message, evidence, None if is_certain else Severity.INFO)


def _are_rounded(records: Records) -> bool:
    """Say whether small changes of rewards are lost."""
    values = np.concatenate([episode.rewards for episode in records.alone])
    return bool(np.abs(values * ROUNDED - np.round(values * ROUNDED)).max(initial=0.0) < 1e-6)


def sample_ordinary_steps(steps: Transitions) -> Transitions:
    """Return some steps in random order, without those whose reward may have a bonus or a penalty for the end."""
    steps = steps.select(~(steps.success | steps.terminated | steps.is_last))
    order = np.random.default_rng(FIRST_SEED).permutation(len(steps.rewards))
    return steps.select(order[:MOST_ROWS])


def _fit_before(steps: Transitions) -> RewardFit | None:
    """Return how the observation before the step gives the reward, if it does, and nothing else explains that."""
    if len(steps.rewards) < FEWEST_ROWS or not steps.names:
        return None
    if np.ptp(steps.rewards) <= EXACT * np.abs(steps.rewards).max():
        return None
    terms = action_terms(steps)
    after = fit_observation(steps, steps.after)
    if after.is_exact or fit_terms(terms, steps.rewards).is_exact:
        return None
    before = fit_observation(steps, steps.before)
    if not before.is_exact or after.median_error < CLEARLY * before.error:
        return None
    # With explicit Euler, the way of a step is the velocity before it: a reward for progress is not late.
    ways = find_simple(steps.after - steps.before, steps.names).values
    others = [np.hstack([terms, ways]), np.hstack([terms, steps.before])]
    return None if any(fit_terms(columns, steps.rewards).is_exact for columns in others) else before


@judges_records("RL617", *rewards.WITH_SEARCH)
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
            yield RuleFinding("RL617", message, {"element": what, "value": int(is_event.sum())})
            return


@dataclasses.dataclass(frozen=True)
class _Limit:
    """A quantity, times a sign, that is below a limit in some events, and in no other step."""

    column: int
    sign: float
    limit: float
    covered: NDArray[np.bool_]  # Shape (n,)

    def crosses(self, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(self.sign * values[:, self.column] < self.limit)


def _find_late_limits(steps: Transitions, is_event: NDArray[np.bool_], most: int) -> str:
    """Return which limits of the state before the step decide; empty if those after it do, or it is not certain."""
    before = _measure(steps.before, steps.names)
    if not (limits := _find_limits(before.values, is_event, most)):
        return ""
    after = _measure(steps.after, steps.names)
    if _find_limits(after.values, is_event, most):
        return ""
    now = np.any([limit.crosses(after.values) for limit in limits], axis=0)
    seeds = len(np.unique(steps.seeds[is_event]))
    missed, is_past = int((now & ~is_event).sum()), bool((is_event & ~now).any())
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
