"""RL610: success at the start."""

import itertools
from collections.abc import Iterator

from rlctl.checking import rewards
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.starts import WHOLE, succeeds_and_goes_on, succeeds_at_once
from rlctl.checking.goal_starts import GoalStarts
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.source_code import write_code
from rlctl.environments.success import SUCCESS

RULE = Rule(
    "RL610",
    "success at the start",
    Severity.WARNING,
    meaning="""
        Many episodes succeed at their first step with the zero action, and are one in the end. The success rate
        then means little, and if success ends an episode, most of the training is wasted. Or the goal that reset
        sets is, in each episode, the very place or direction in which the robot starts.
    """,
    fix="""
        Draw start and goal again until they are apart, and compute success from the state of this episode, not
        of the last one.
    """,
)

FEWEST_STARTS = 10
MANY_AT_START = 0.2  # part of the starts: a goal may be near the robot by chance


@judges_expressions(RULE, decides=False)
def _find_goal_at_start(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in itertools.islice(noted.share(GoalStarts).find_at_start(), 1):
        yield RuleFinding(RULE, one.what, {"element": write_code(one.node)}, where=one.where)


@judges_records(RULE, "starts")
def _find_success_at_start(records: Records) -> Iterator[RuleFinding]:
    starts = [episode for episode in records.role("starts") if episode.steps]
    if len(starts) < FEWEST_STARTS:
        raise NotJudged("no step could be taken" if records.role("starts") else records.why_missing("starts"))
    if not any(SUCCESS in start.infos for start in starts):
        raise NotApplicable("is_success is not reported at the first step")
    at_once = [start for start in starts if succeeds_at_once(start)]
    going_on = sum(map(succeeds_and_goes_on, at_once))
    whole = records.role(WHOLE)
    kept = sum(map(rewards.ends_in_success, whole)) / len(whole) if whole else 1.0  # of those that go on
    share = (len(at_once) - going_on * (1.0 - kept)) / len(starts)
    if share > MANY_AT_START:
        message = f"{len(at_once)} of {len(starts)} episodes are a success after one step with the zero action"
        if kept < 1.0:
            message += f", and {100 * kept:.0f} % of those that go on are one in the end"
        yield RuleFinding(RULE, message, at_once[0].at(1, value=share, expected=f"up to {MANY_AT_START}"))
