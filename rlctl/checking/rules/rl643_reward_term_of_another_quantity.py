"""RL643: reward term of another quantity."""

import ast
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.other_quantities import KernelReader
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL643",
    "reward term of another quantity",
    Severity.WARNING,
    meaning="""
        A term of the reward is a function such as exp(-(x / width)**2), and x is another quantity than the name of the
        term says: near is computed from the heading, say, which a term of its own pays already, while the distance is
        known. Or the arguments of such a function are exchanged: it is given a constant as the quantity, and the
        quantity as the width. The policy is paid for something else than what is meant.
    """,
    fix="Give the function the quantity that the term is named after, and then the width.",
)


@judges_expressions(RULE, decides=False)
def _find_others(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    reader = notes.share(KernelReader)
    for one in reader.find_others():
        message = f"{one.name!r} names a {one.named} and is {ast.unparse(one.call)}, a function of a {one.kind},"
        message += f" {ast.unparse(one.given)}, which another term pays; {one.meant} would be the {one.named}"
        where = notes.source.find_place(one.call)
        yield RuleFinding(RULE, message, {"term": one.name, "value": ast.unparse(one.given)}, where=where)
        return
    for call in reader.find_exchanged():
        text = ast.unparse(call)
        message = f"{text} is given a constant as the quantity, and what changes as the width: they are exchanged"
        yield RuleFinding(RULE, message, {"term": text}, where=notes.source.find_place(call))
        return
