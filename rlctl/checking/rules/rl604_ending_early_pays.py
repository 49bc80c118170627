"""RL604: ending early pays."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity

RULE = Rule(
    "RL604",
    "ending early pays",
    Severity.WARNING,
    meaning="""
        All rewards are negative, and something that is not a success can end an episode early. Falling over
        soon then costs less than trying for long, and the policy learns that first. A warning if is_success is
        false at the end, or if the last reward is among the worst; no finding if the end looks like a goal.
    """,
    fix="""
        Give a failure a penalty that is worse than continuing badly to the end, or add a bonus per step, or do
        not end the episode. If the end is the goal, report it in info['is_success'].
    """,
)

LIKE_A_GOAL, LIKE_ANY = 0.9, 0.5  # of all rewards up to the last one: like a goal, like any; less: a failure


@judges_records(RULE, *rewards.WITH_SEARCH, of_absence=True)
def _find_paid_ends(records: Records) -> Iterator[RuleFinding]:
    episodes = rewards.require_rewarded(records)
    if not any(episode.terminated.any() for episode in episodes):
        raise NotApplicable("nothing ended an episode early")
    longest = records.require_built().max_steps or max(episode.steps for episode in episodes)
    inner = np.concatenate([episode.rewards[: episode.steps - episode.has_ended] for episode in episodes])
    ended = [episode for episode in episodes if episode.ended == "terminated" and episode.steps < longest]
    early = [episode for episode in ended if not rewards.ends_in_success(episode)]
    if not early or not inner.size or inner.max() > 0 or inner.mean() == 0:
        return
    mean = float(inner.mean())
    saved = [-rewards.DISCOUNT * rewards.discounted_steps(mean, longest - episode.steps) for episode in early]
    gains = [float(episode.rewards[-1]) - mean + much for episode, much in zip(early, saved, strict=True)]
    gain = float(np.median(gains))
    severity = _severity_of_end(episodes, early, inner)
    if gain <= 0 or severity is None:
        return
    usual = int(np.argsort(gains)[len(gains) // 2])
    example, last = early[usual], float(early[usual].rewards[-1])
    ends = f"{len(early)} of {len(episodes)} episodes ended early without success"
    why = f"The mean reward is {mean:.3g} and none but the last is above 0, so ending at step {example.steps} with"
    much = f"{saved[usual]:.3g} (discounted by {rewards.DISCOUNT} up to step {longest})"
    message = f"{ends}. {why} {last:.3g} saves {much}"
    yield RuleFinding(RULE, message, example.at(example.steps, value=last, mean_reward=mean, gain=gain), severity)


def _severity_of_end(
    episodes: Sequence[CheckedEpisode], early: Sequence[CheckedEpisode], inner: NDArray[np.float64]
) -> Severity | None:
    if rewards.reports_success(episodes):
        return Severity.WARNING
    as_good_as = float(np.median([np.mean(inner <= episode.rewards[-1]) for episode in early]))
    if as_good_as >= LIKE_A_GOAL:
        return None
    return Severity.INFO if as_good_as >= LIKE_ANY else Severity.WARNING
