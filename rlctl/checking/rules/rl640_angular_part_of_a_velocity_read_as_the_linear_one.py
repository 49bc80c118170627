"""RL640: angular part of a velocity read as the linear one."""

from collections.abc import Iterator

from rlctl.checking.angular_parts import find_angular_parts, find_other_halves
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.records import ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL640",
    "angular part of a velocity read as the linear one",
    Severity.WARNING,
    meaning="""
        MuJoCo gives the velocity of a body as six numbers, the angular velocity first: mj_objectVelocity, and
        data.cvel. The source reads the first three as a linear velocity, a speed or a slip. A foot that slides
        without turning then has no speed, and one that turns about its tip is fast. Or the source reads the half of
        the velocity of a free joint, in qvel, that is not what it is called, or parts of both.
    """,
    fix="Take the last three numbers, velocity[3:6], as the linear velocity, and the first three as the angular one.",
)


HALVES = "Of a free joint the first three numbers in qvel are the linear velocity, and the next three the angular one."


@judges_expressions(RULE)
def _find_angular_parts(notes: NotedEpisodes) -> Iterator[ChildMessage]:
    for word, text, where in find_angular_parts(notes):
        message = f"{text} is called {word!r}, and is the angular part of the velocity, which MuJoCo puts first"
        yield RuleFinding(RULE, message, {"element": text}, where=where)
        return
    for called, what, text, where in find_other_halves(notes):
        parts = "the linear velocity of a free joint is followed by the angular one"
        message = f"{text} is called {called}, and is {what}: {parts}"
        yield RuleFinding(RULE, message, {"element": text}, where=where, fix=HALVES)
        return
