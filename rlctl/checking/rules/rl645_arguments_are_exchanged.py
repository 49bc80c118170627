"""RL645: arguments are exchanged."""

from collections.abc import Iterator

from rlctl.checking.exchanged_arguments import CallReader
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names

RULE = Rule(
    "RL645",
    "arguments are exchanged",
    Severity.WARNING,
    meaning="""
        A function is called with two arguments in each other's place: what it takes as the low limit was above the
        high one in each call, or two arguments have the names of each other's parameters, and a step in which both
        are exchanged back pays or shows something else. Such calls raise no error: limits that are the wrong way
        round often mean no limit.
    """,
    fix="Give the arguments in the order of the parameters, or by their names.",
)


@judges_expressions(RULE)
def _find_exchanged(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    for one in CallReader(notes).find():
        given = list_names([f"{value} for {name}" for name, value in one.given.items()])
        message = f"{one.function} is given {given}"
        yield RuleFinding(RULE, message, {"element": one.function}, where=one.where)
        return
