"""RL606: doing nothing pays."""

from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL606",
    "doing nothing pays",
    Severity.INFO,
    meaning="""
        The zero action earns a positive return to the end, and no recorded episode earns more: a policy can
        settle for standing still. That may be the task, so this is an info; a warning if info["reward_terms"]
        shows that most of the return is a constant bonus.
    """,
    fix="""
        Make the bonus for being alive smaller than what the task itself pays, or pay it only together with
        progress, and see with --json what each term earns.
    """,
)

NEARLY = 0.05  # How much better than doing nothing something has to be, to be better
COMPARED_STEPS = 200  # How much of the episodes is compared at most: the search's are no longer
FEWEST_COMPARED, SHORTEST_COMPARED = 10, 10  # Episodes; steps of each
MOST_OF = 0.5


@judges_records(RULE, *rewards.WITH_SEARCH, of_absence=True)
def _find_paid_idleness(records: Records) -> Iterator[RuleFinding]:
    compared = [episode for episode in rewards.require_rewarded(records) if episode.role in ("episodes", "search")]
    idle = [episode for episode in compared if episode.actions == "zero"]
    others = [episode for episode in compared if episode.actions != "zero"]
    if not idle or len(others) < FEWEST_COMPARED:
        raise NotJudged(f"{len(idle)} episodes with zero actions and {len(others)} others were recorded")
    steps = min(COMPARED_STEPS, *(episode.steps for episode in idle))
    if any(episode.terminated.any() or rewards.has_succeeded(episode) for episode in idle) or steps < SHORTEST_COMPARED:
        return
    nothing = [rewards.discounted_sum(episode.rewards[:steps]) for episode in idle]
    whole = [episode for episode in others if episode.steps >= steps or episode.has_ended]
    something = [rewards.discounted_sum(episode.rewards[:steps]) for episode in whole]
    if not something or len({float(reward) for episode in compared for reward in episode.rewards[:steps]}) == 1:
        return  # a reward that never changes is RL602's
    mean, best = float(np.mean(nothing)), max(something)
    if mean <= 0 or min(nothing) <= 0 or best > mean + NEARLY * abs(mean):
        return
    bonus, share = _bonus(idle)
    because = f"; {100 * share:.0f} % of it is the term {bonus!r}, which never changes" if bonus else ""
    earned = f"doing nothing earns {mean:.4g} over {steps} steps (discounted by {rewards.DISCOUNT})"
    message = f"{earned}, the best of {len(something)} other episodes {best:.4g}{because}"
    evidence = idle[0].at(steps, value=mean, best=best, term=bonus, share=share)
    is_named = any(rewards.has_terms(episode) for episode in records.alone)
    yield RuleFinding(RULE, message, evidence, Severity.WARNING if bonus and is_named else Severity.INFO)


def _bonus(idle: Sequence[CheckedEpisode]) -> tuple[str | None, float]:
    total = sum(float(np.nansum(np.abs(values))) for episode in idle for values in rewards.find_terms(episode).values())
    if total <= 0 or not all(rewards.has_terms(episode) for episode in idle):
        return None, 0.0
    steps = sum(episode.steps for episode in idle)
    shares = {name: value * steps / total for name, value in rewards.find_constant_terms(idle).items() if value > 0}
    largest = max(shares, key=lambda name: shares[name], default=None)
    return (largest, shares[largest]) if largest is not None and shares[largest] >= MOST_OF else (None, 0.0)
