"""RL601: reward not finite."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL601",
    "reward not finite",
    Severity.ERROR,
    meaning="""
        A reward is NaN or infinite. One such number turns all weights of a network into NaN. Where the observation of
        that episode is so first, RL104 names the cause.
    """,
    fix="Find the division, logarithm or diverging simulation that causes it.",
)


@judges_records(RULE)
def _find_not_finite(records: Records) -> Iterator[RuleFinding]:
    for episode in records.require_alone():
        wrong = np.flatnonzero(~np.isfinite(episode.rewards) & episode.reward_is_number)
        if wrong.size:
            step, value = int(wrong[0]) + 1, str(episode.rewards[wrong[0]])
            evidence = episode.at(step, value=value, expected="finite")
            same = ("RL104",) if _follows_observation(episode, step) else ()
            yield RuleFinding(RULE, f"the reward is {value} at step {step}", evidence, same=same)
            return


def _follows_observation(episode: CheckedEpisode, step: int) -> bool:
    """Say whether the observation of a step, or of one before it, is not finite either."""
    series = episode.observations.values()
    return any(not np.isfinite(one.rows[one.steps <= step]).all() for one in series)
