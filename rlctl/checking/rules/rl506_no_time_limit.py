"""RL506: no time limit."""

from collections.abc import Iterator

from rlctl.checking.episode_ends import SHORTEST_TIE, require_episodes, require_two_flags, use_registration
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.rules.rl501_time_limit_flagged_as_terminated import find_time_limit_as_terminated

RULE = Rule(
    "RL506",
    "no time limit",
    Severity.WARNING,
    meaning="""
        Every episode so far ended in failure (or success), and there is no time limit. A good policy that
        neither falls nor arrives then never ends its episode: training and evaluation stop in it. An info if
        the code of step cannot be read, and for games, whose observations are whole numbers.
    """,
    fix="""
        Wrap it in gymnasium.wrappers.TimeLimit, register it with max_episode_steps, or count steps and return
        truncated=True at the last. If step sets terminated=True when time is up, set truncated instead.
    """,
)


@judges_records(RULE, "episodes", "search", of_absence=True)
def _find_no_time_limit(records: Records) -> Iterator[RuleFinding]:
    built, episodes = records.require_built(), require_episodes(records)
    if built.max_steps is not None or any(episode.ended != "terminated" for episode in episodes):
        return  # those that did not end are RL503's
    lengths = [episode.steps for episode in episodes]
    is_continuous = any(leaf.kind == "Box" and leaf.dtype.startswith("float") for leaf in built.leaves)
    if len(set(lengths)) == 1 or (max(lengths) < SHORTEST_TIE and not is_continuous):
        return  # a bandit, or a game of a few moves
    require_two_flags(records)
    if list(find_time_limit_as_terminated.run(records)):
        raise NotJudged("a time limit seems to be flagged as terminated (RL501)")
    if built.truncation == "computed":
        return  # its limit was not reached
    why = "step always returns truncated=False" if built.truncation == "never" else "none is declared or was reached"
    ends = f"all {len(episodes)} episodes ended with terminated=True, the longest after {max(lengths)} steps"
    evidence = {"episodes": len(episodes), "value": None, "expected": "max_episode_steps", "step": max(lengths)}
    severity = Severity.WARNING if is_continuous and built.truncation == "never" else Severity.INFO
    message = f"no time limit was seen: {why}; {ends}"
    yield RuleFinding(RULE, message, evidence, severity, fix=use_registration(records))
