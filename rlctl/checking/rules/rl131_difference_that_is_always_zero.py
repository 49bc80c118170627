"""RL131: difference that is always zero."""

from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.source_code import write_code
from rlctl.checking.zero_differences import ZeroDifferences

RULE = Rule(
    "RL131",
    "difference that is always zero",
    Severity.WARNING,
    meaning="""
        A velocity, or another change since the last step, is 0 in each step although the value changes: the value of
        the last step has been replaced by the new one before the difference is taken. Or both are the same array:
        self.last = self.position keeps no copy, and what is written into the one is in the other. The observation is
        computed from it, or a value that is kept from step to step, such as a filtered velocity, which then stays
        near 0. Where the reward is computed from it, that is RL620.
    """,
    fix="""
        Take the difference first, then replace the value of the last step, by a copy: self.last = position.copy().
    """,
)


@judges_expressions(RULE, decides=False)
def _find_zero_differences(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    zeros = noted.share(ZeroDifferences)
    for one in zeros.find_observed():
        message = f"{one.whole.text} is 0 in all {len(noted.steps)} steps, although {one.new.text} changes:"
        message += f" {one.key} has been replaced by it before, or is the same array"
        yield RuleFinding(RULE, message, {"element": one.whole.text, "value": 0.0}, where=one.whole.where)
        return
    for update in zeros.find_updates():
        one, where = update.difference, noted.source.find_place(update.statement)
        message = f"{write_code(update.statement)} is computed where {one.whole.text} is 0 in each step, although"
        message += f" {one.new.text} changes: {one.key} has been replaced by it before, or is the same array"
        yield RuleFinding(RULE, message, {"element": one.whole.text, "value": 0.0}, where=where)
        return
