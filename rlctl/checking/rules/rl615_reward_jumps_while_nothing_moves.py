"""RL615: reward jumps while nothing moves."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rewards import require_rewarded
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL615",
    "reward jumps while nothing moves",
    Severity.WARNING,
    meaning="""
        With the zero action the observation stands still and the reward jumps from one value to another:
        something that is not observed, most often the goal, changes inside step. The policy cannot see the
        change.
    """,
    fix="Put the goal, or what else changes, into the observation, or draw it in reset only.",
)

REST_STEPS = 3  # So many steps before and after a jump everything has to stand still
STILL = 1e-6


@judges_records(RULE, "episodes", "search")
def _find_jump_at_rest(records: Records) -> Iterator[RuleFinding]:
    require_rewarded(records)
    for episode in records.role("episodes") + records.role("search"):
        size = episode.steps - episode.has_ended
        if episode.actions != "zero" or size < 2 * REST_STEPS or not episode.observations:
            continue
        rewards = episode.rewards[:size]
        still = np.ones(size, np.bool_)
        for series in episode.observations.values():
            if len(series.values) != episode.steps + 1:
                return
            still &= np.abs(np.diff(series.rows, axis=0)).max(axis=1, initial=0.0)[:size] <= STILL
        level = np.asarray(np.abs(np.diff(rewards)) <= STILL * np.maximum(1.0, np.abs(rewards[1:])))
        for at in np.flatnonzero(~level).tolist():
            before, after = slice(max(0, at - REST_STEPS), at), slice(at + 1, at + 1 + REST_STEPS)
            calm = level[before].all() and level[after].all() and still[before].all() and still[at : after.stop].all()
            if len(rewards[before]) == REST_STEPS == len(level[after]) and calm:
                jump = f"from {rewards[at]:.4g} to {rewards[at + 1]:.4g} at step {at + 2}"
                evidence = episode.at(at + 2, value=float(rewards[at + 1]), expected=float(rewards[at]))
                yield RuleFinding(RULE, f"the reward jumps {jump}, but the observation does not change", evidence)
                return
