"""RL602: reward never changes."""

from collections.abc import Iterator

from rlctl.checking.clipped_rewards import find_clipped_rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.records import Records
from rlctl.checking.rewards import WITH_SEARCH, has_succeeded, require_rewarded, summarize
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL602",
    "reward never changes",
    Severity.WARNING,
    meaning="""
        Every recorded step has the same reward, and no episode ends early: there is nothing to learn from. An
        info for a reward of 0 or below, which may be sparse (MountainCar); a positive reward, or one that is
        the same in success too, is likely a mistake. Or the source clips the reward, as in max(0, reward), and
        what it clips is beyond the limit at every step.
    """,
    fix="""
        Let the reward say what is better: a term for the distance to the goal, or for progress. A sparse reward
        needs demonstrations, a curriculum, or many more steps. Of a clipped reward look which cost is so large.
    """,
)


@judges_records(RULE, *WITH_SEARCH, of_absence=True)
def _find_constant_reward(records: Records) -> Iterator[RuleFinding]:
    episodes = require_rewarded(records)
    constant = float(episodes[0].rewards[0])
    if any((episode.rewards != constant).any() or episode.terminated.any() for episode in episodes):
        return
    at_success = any(has_succeeded(episode) for episode in episodes)
    also = ", also where is_success is true" if at_success else ""
    message = f"the reward is {constant:g} at every step of {summarize(episodes)}{also}; nothing ends an episode early"
    evidence = {"value": constant, "episodes": len(episodes), "steps": sum(episode.steps for episode in episodes)}
    severity = Severity.WARNING if constant > 0 or at_success else Severity.INFO
    yield RuleFinding(RULE, message, evidence, severity)


@judges_expressions(RULE, decides=False)
def _find_clipped(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in find_clipped_rewards(notes):
        message = f"{one.clip.text} is {one.limit:g} at all {one.steps} steps that were looked at: {one.inner.text} is"
        message += f" from {one.low:.4g} to {one.high:.4g}"
        evidence = {"element": one.clip.text, "value": one.limit, "steps": one.steps}
        yield RuleFinding(RULE, message, evidence, where=one.clip.where)
        return
