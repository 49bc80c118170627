"""RL503: episodes never end."""

from collections.abc import Iterator

from rlctl.checking.episode_ends import require_episodes, use_registration
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity

RULE = Rule(
    "RL503",
    "episodes never end",
    Severity.WARNING,
    meaning="""
        Episodes do not end, and no time limit is known. Most of a training may then pass in one useless state,
        returns are never complete, and an evaluation ends with an error after 20,000 steps.
    """,
    fix="""
        Wrap it in gymnasium.wrappers.TimeLimit, register it with max_episode_steps, or count steps and return
        truncated=True at the last. If step sets terminated=True when time is up, set truncated instead.
    """,
)

ENOUGH_STEPS = 1_000  # shorter episodes without an end are too short to judge


@judges_records(RULE, "episodes", of_absence=True)
def _find_endless(records: Records) -> Iterator[RuleFinding]:
    limit, episodes = records.require_built().max_steps, require_episodes(records)
    if any(episode.ended == "truncated" for episode in episodes):
        return
    longest: dict[str, int] = {}
    for episode in episodes:
        if not episode.has_ended:
            longest[episode.actions] = max(longest.get(episode.actions, 0), episode.steps)
    if not any(longest.values()):
        return
    if max(longest.values()) < (limit or ENOUGH_STEPS):
        raise NotJudged(f"no end within {max(longest.values())} steps; longer episodes are not played")
    declared = f"its own limit is {limit}" if limit else "no time limit is known"
    steps = ", ".join(f"{count:,} with {kind} actions" for kind, count in longest.items())
    message = f"no episode ended after so many steps: {steps}; {declared}"
    yield RuleFinding(RULE, message, {"steps": longest, "expected": limit}, fix=use_registration(records))
