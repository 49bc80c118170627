"""RL637: progress is counted from the start; one of its experiments is that of RL114."""

from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.previous_values import KeptDifferences
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL637",
    "progress is counted from the start",
    Severity.WARNING,
    meaning="""
        The reward pays progress, the distance before minus the distance now, and the distance before is set in reset
        and never again: each step is paid for the whole way since the start, also those in which nothing moves. The
        check replaced an attribute that is named after the previous step: the same episode then had the same
        observations, and other rewards in most steps, not only in the first one. Or it saw in the source that steps
        subtract such an attribute, pay the difference, and do not set it again, or only where a new goal comes.
    """,
    fix="Set the previous value in each step, after the reward is computed.",
)


@judges_expressions(RULE, decides=False)
def _find_differences(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in noted.share(KeptDifferences).find_never_replaced():
        message = f"{one.key} stays what it was at the start in {len(noted.steps)} steps, and each of them pays"
        message += f" {one.whole.text}: not what has changed in the step, but since the start or the last goal"
        yield RuleFinding(RULE, message, {"element": one.key}, where=one.whole.where)
