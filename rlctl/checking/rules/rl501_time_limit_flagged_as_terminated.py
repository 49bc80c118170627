"""RL501: time limit flagged as terminated."""

from collections.abc import Iterator, Sequence

from rlctl.checking.episode_ends import FEWEST_EPISODES, SHORTEST_TIE, require_episodes, require_two_flags
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.held import HeldEpisode
from rlctl.checking.records import ENDS, CheckedEpisode, Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL501",
    "time limit flagged as terminated",
    Severity.WARNING,
    meaning="""
        Episodes end with `terminated` after exactly the same number of steps. Learning then treats running out
        of time as a state without a future: values near the end are wrong, and the policy learns to hurry or to
        give up. A task that really is over after so many steps looks the same, so this is a warning. An info if
        the last reward is unlike any before, as at an obstacle that no episode passes. A robot that falls sooner
        was put back to its start before every step; an info if it could not be carried along as well, because the
        end may come after some steps without progress.
    """,
    fix="Return terminated=False, truncated=True when time is up, or use gymnasium.wrappers.TimeLimit.",
)

FEWEST_TIES = 4
SHORTEST_LIMIT = 5  # shorter games with one length have no time limit [steps]


@judges_records(RULE, "episodes", "search", "held")  # of absence too, but for the counter
def find_time_limit_as_terminated(records: Records) -> Iterator[RuleFinding]:
    """Yield that episodes end with `terminated` when their time is up."""
    episodes = require_episodes(records)
    require_two_flags(records)
    if any(episode.ended in ("truncated", "both") for episode in episodes):
        return
    ended = [episode for episode in episodes if episode.ended == "terminated"]
    limit = max((episode.steps for episode in ended), default=0)
    if counter := (built := records.require_built()).counter:
        message = f"step sets terminated by a counter ({counter}), and truncated is always False"
        flags = {"value": "terminated", "expected": "truncated"}
        yield RuleFinding(RULE, message, flags, where=built.counter_place)
        return
    longest = max(episode.steps for episode in [*episodes, *records.role("search")])
    held = records.facts.get("held", [])
    if found := list(_judge_held(held, longest)):
        yield from found
        return
    if any(len(episode.rewards) > limit for episode in held):
        return  # what ends the others is a fall
    records.require_whole("episodes", "search")
    longer = [episode for episode in episodes if episode.ended not in ENDS] + records.role("search")
    if any(episode.steps > limit for episode in longer):
        return
    if len(ended) < FEWEST_EPISODES or len({episode.actions for episode in ended}) < 2:
        raise NotJudged(f"only {len(ended)} episodes ended")
    ties = [episode for episode in ended if episode.steps == limit]
    of = {"episodes": len(ties), "of": len(episodes)}
    evidence = {"step": limit, **of, "value": "terminated", "expected": "truncated"}
    has_obstacle = all(_ends_with_odd_reward(episode) for episode in ties)
    if limit >= SHORTEST_LIMIT and len(ties) == len(episodes):
        message = f"all {len(ties)} episodes, whatever the actions, end at step {limit} with terminated=True"
        if has_obstacle:
            message += ", and with a reward unlike any before: a time limit, or an obstacle that none of them passes"
        yield RuleFinding(RULE, message, evidence, Severity.INFO if has_obstacle else None)
    elif limit >= SHORTEST_TIE and len(ties) >= FEWEST_TIES and len({episode.actions for episode in ties}) > 1:
        message = f"{len(ties)} of {len(episodes)} episodes end at step {limit} with terminated=True, none later"
        yield from () if has_obstacle else (RuleFinding(RULE, message, evidence),)


def _ends_with_odd_reward(episode: CheckedEpisode) -> bool:
    before, last = episode.rewards[:-1], episode.rewards[-1]
    return bool(before.size and (last < before.min() or last > before.max()))


def _judge_held(held: Sequence[HeldEpisode], longest: int) -> Iterator[RuleFinding]:
    """Judge episodes that only time can end; none of the others went on for longer."""
    limits = {len(episode.rewards) for episode in held}
    limit = max(limits, default=0)
    is_limit = len(limits) == 1 and limit > SHORTEST_TIE and limit >= longest
    if not is_limit or {episode.ended for episode in held} != {"terminated"}:
        return
    is_carried = any(episode.moves for episode in held)
    kept = "put back to its start, or carried along," if is_carried else "put back to its start"
    message = (
        f"with the robot {kept} before every step, all {len(held)} episodes end at step {limit} with terminated=True"
    )
    if not is_carried:
        message += ": a time limit, or a limit of steps without progress"
    evidence = {"step": limit, "episodes": len(held), "value": "terminated", "expected": "truncated"}
    yield RuleFinding(RULE, message, evidence, None if is_carried else Severity.INFO)
