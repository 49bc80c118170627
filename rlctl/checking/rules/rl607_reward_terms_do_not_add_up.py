"""RL607: reward terms do not add up."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rewards import SUM_TOLERANCE, WITH_SEARCH, find_wrong_sums, join_terms, require_terms, sum_terms
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
ROUNDS = 5  # of a fit without the steps that have a bonus of their own
ORDINARY = 0.95  # part of the steps that have none
LEAST = 1e-6  # weights that are 0 but for rounding


@judges_records(RULE, *WITH_SEARCH)
def _find_wrong_sum(records: Records) -> Iterator[RuleFinding]:
    episodes = require_terms(records)
    off = find_wrong_sums(episodes)
    if off.any():
        worst = int(off.argmax())
        episode, step = [(episode, step) for episode in episodes for step in range(1, episode.steps + 1)][worst]
        total, reward = float(sum_terms(episodes)[worst]), float(episode.rewards[step - 1])
        example = f"at step {step} their sum is {total:.6g} and the reward {reward:.6g}"
        message = f"reward_terms do not add up to the reward in {np.count_nonzero(off)} of {len(off)} steps: {example}"
        severity = Severity.WARNING
        if weights := _find_weights(episodes):
            severity = Severity.INFO
            listed = ", ".join(f"{name} {weight:.3g}" for name, weight in weights.items())
            message += f"; with weights they do: {listed}"
        yield RuleFinding(RULE, message, episode.at(step, value=total, expected=reward), severity)


def _find_weights(episodes: Sequence[CheckedEpisode]) -> dict[str, float]:
    """Return constant weights with which all terms, and a constant, are the reward; empty where there are none."""
    terms = join_terms(episodes)
    rewards = np.concatenate([episode.rewards for episode in episodes])
    columns = [values for values in terms.values() if len(values) == len(rewards)]
    if not columns or len(columns) < len(terms):
        return {}
    table = np.column_stack([*columns, np.ones(len(rewards))])
    known = np.isfinite(table).all(axis=1) & np.isfinite(rewards)
    table, rewards = table[known], rewards[known]
    allowed = SUM_TOLERANCE * np.maximum(1.0, np.abs(rewards))
    chosen = np.arange(len(rewards))
    weights = np.zeros(table.shape[1])
    for _ in range(ROUNDS):
        weights = np.linalg.lstsq(table[chosen], rewards[chosen], rcond=None)[0]
        off = np.abs(table @ weights - rewards)
        if np.mean(off <= allowed) >= ORDINARY:
            found = zip([*terms, "constant"], weights.tolist(), strict=True)
            used = {name: weight for name, weight in found if abs(weight) > LEAST}
            return used if used.keys() >= terms.keys() else {}
        chosen = np.argsort(off)[: int(ORDINARY * len(rewards))]
    return {}
