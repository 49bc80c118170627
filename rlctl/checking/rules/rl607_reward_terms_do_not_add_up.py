"""RL607: reward terms do not add up."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH, find_terms, require_terms
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL607",
    "reward terms do not add up",
    Severity.WARNING,
    meaning="""
        The sum of info["reward_terms"] is not the reward, so conclusions from the logged terms are wrong: a
        term is missing, has no weight, or is counted twice.
    """,
    fix="Put all weighted terms into info['reward_terms'] and compute the reward as their sum.",
)

SUM_TOLERANCE = 1e-3  # part of the reward or of 1: terms may be rounded for the log
FEW_WRONG = 0.02  # part of the steps: the last of an episode may have a bonus


@judges_records(RULE, *WITH_SEARCH)
def _find_wrong_sum(records: Records) -> Iterator[RuleFinding]:
    episodes = require_terms(records)
    totals = [np.sum(list(find_terms(episode).values()), axis=0) for episode in episodes]
    rewards = np.concatenate([episode.rewards for episode in episodes])
    off = np.abs(np.concatenate(totals) - rewards) / np.maximum(1.0, np.abs(rewards))
    off = np.nan_to_num(off)  # a step without terms
    wrong, worst = int((off > SUM_TOLERANCE).sum()), int(off.argmax())
    if wrong > FEW_WRONG * len(off):
        episode, step = [(episode, step) for episode in episodes for step in range(1, episode.steps + 1)][worst]
        total, reward = float(np.concatenate(totals)[worst]), float(rewards[worst])
        example = f"at step {step} their sum is {total:.6g} and the reward {reward:.6g}"
        message = f"reward_terms do not add up to the reward in {wrong} of {len(off)} steps: {example}"
        yield RuleFinding(RULE, message, episode.at(step, value=total, expected=reward))
