"""RL616: reward is one step late."""

import contextlib
from collections.abc import Iterator

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.rates import find_rates
from rlctl.checking.records import FIRST_SEED, Records
from rlctl.checking.regression import EXACT, RewardFit, action_terms, fit_observation, fit_terms
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.transitions import Transitions, collect_transitions, find_simple, sample_ordinary_steps

RULE = Rule(
    "RL616",
    "reward is one step late",
    Severity.WARNING,
    meaning="""
        The reward of a step is a function of the observation before it, and not of the one that the step
        returns: the reward is computed before the simulation advances, so the state in which the goal is
        reached is never rewarded. Where the observation does not contain what the reward is made of, the time
        shows it: the first action changes every element of the observation that it changes by one step, but the
        reward only from the next step on; an info where nothing is known of how the environment integrates. Not
        judged where no success is reported: a cost of the state and the action chosen in it is a usual
        convention. A reward for progress or speed may stand for the velocity before the step, and is not
        reported.
    """,
    fix="Compute the reward after the simulation has advanced, from the new state.",
)

FEWEST_ROWS = 300
ROUNDED = 1e4  # to so many parts of 1
CLEARLY = 100.0  # how much worse the observation after the step has to fit than the one before
ACTS = "action effects"  # The experiment that knows when the first action changes what


@judges_records(RULE, *rewards.WITH_SEARCH, ACTS)
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
    # All of the state has answered by the first step: then nothing was left for the second one but the reward.
    is_certain |= first.get("state") == first["observation"] > 0
    if fit is not None:
        of = f" ({', '.join(fit.picked)})" if fit.picked else ""
        exact = f"to within {max(fit.error, 1e-9):.0e} of its spread"
        message = (
            f"the reward is a function of the observation before the step{of}, {exact}, "
            "and not of the observation that the step returns"
        )
        yield RuleFinding(RULE, message, {"value": fit.error})
    elif first["reward"] > first["observation"] and not _are_rounded(records):
        observed, late = first["observation"], first["reward"]
        message = (
            f"the first action changes the observation by step {observed}, but the reward only from step {late} on"
        )
        evidence = {"seed": FIRST_SEED, "value": late, "expected": observed, "step": 1}
        yield RuleFinding(RULE, message, evidence, None if is_certain else Severity.INFO)


def _are_rounded(records: Records) -> bool:
    """Say whether small changes of rewards are lost."""
    values = np.concatenate([episode.rewards for episode in records.alone])
    return bool(np.abs(values * ROUNDED - np.round(values * ROUNDED)).max(initial=0.0) < 1e-6)


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
