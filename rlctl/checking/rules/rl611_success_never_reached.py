"""RL611: success never reached."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL611",
    "success never reached",
    Severity.INFO,
    meaning="""
        info reports success, but none came in any recorded episode, a search for high returns included. A
        hard task looks the same, so this is an info; but a success that no state can reach is a common mistake,
        and shows only after the training.
    """,
    fix="""
        Put the robot at the goal by hand and check that a success is reported. If it is, the goal is only hard to
        find.
    """,
)

FEWEST_EPISODES = 20  # Fewer episodes say little about whether one can succeed
FEWEST_STEPS = 500  # Steps of them: less is what raises, or ends, at once


@judges_records(RULE, *rewards.WITH_SEARCH, of_absence=True)
def _find_no_success(records: Records) -> Iterator[RuleFinding]:
    episodes = rewards.require_readable(records)
    if not rewards.reports_success(episodes):
        raise NotApplicable("info reports no success")
    if any(rewards.has_succeeded(episode) for episode in episodes):
        return
    steps = sum(episode.steps for episode in episodes)
    if len(episodes) < FEWEST_EPISODES or steps < FEWEST_STEPS or not records.role("search"):
        reason = f"only {len(episodes)} episodes with {steps} steps were recorded"
        raise NotJudged(records.skipped.get("search", reason))
    best = max(episodes, key=lambda episode: float(np.nan_to_num(episode.rewards, nan=-np.inf).max()))
    step = int(np.nan_to_num(best.rewards, nan=-np.inf).argmax())
    reward = float(best.rewards[step])
    message = f"no success in {rewards.summarize(episodes)}; best reward {reward:.4g} at step {step + 1}"
    yield RuleFinding(RULE, message, best.at(step + 1, value=reward, episodes=len(episodes)))
