"""RL607: reward terms do not add up."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH, find_weights, find_wrong_sums, require_logged_terms, sum_terms
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL607",
    "reward terms do not add up",
    Severity.WARNING,
    meaning="""
        The sum of info["reward_terms"] is not the reward, so conclusions from the logged terms are wrong: a
        term is missing, has no weight, or is counted twice. An info where constant weights, and a constant, make the
        terms the reward: then they are logged without their weights, and only their sizes are misleading.
    """,
    fix="Put all weighted terms into info['reward_terms'] and compute the reward as their sum.",
)


@judges_records(RULE, *WITH_SEARCH)
def _find_wrong_sum(records: Records) -> Iterator[RuleFinding]:
    episodes = require_logged_terms(records)
    off = find_wrong_sums(episodes)
    if off.any():
        worst = int(off.argmax())
        episode, step = [(episode, step) for episode in episodes for step in range(1, episode.steps + 1)][worst]
        total, reward = float(sum_terms(episodes)[worst]), float(episode.rewards[step - 1])
        example = f"at step {step} their sum is {total:.6g} and the reward {reward:.6g}"
        message = f"reward_terms do not add up to the reward in {np.count_nonzero(off)} of {len(off)} steps: {example}"
        severity = Severity.WARNING
        if weights := find_weights(episodes):
            severity = Severity.INFO
            listed = ", ".join(f"{name} {weight:.3g}" for name, weight in weights.items())
            message += f"; with weights they do: {listed}"
        yield RuleFinding(RULE, message, episode.at(step, value=total, expected=reward), severity)
