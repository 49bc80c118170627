"""RL133: observed difference is not wrapped."""

from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.unwrapped_angles import UnwrappedAngles

RULE = Rule(
    "RL133",
    "observed difference is not wrapped",
    Severity.WARNING,
    meaning="""
        The observation has a difference of two directions that is more than half a turn, such as the heading of a
        goal and that of the robot: an error of 0.1 rad is then shown as one of 6.2 with the other sign. The check
        made it a whole turn less, which is the same, and something else was observed.
    """,
    fix="Wrap the difference, (a - b + pi) % (2 * pi) - pi, or observe its sine and cosine.",
)


@judges_expressions(RULE)
def _find_differences(notes: NotedEpisodes) -> Iterator[RuleFinding]:
    for one, largest in notes.share(UnwrappedAngles).find_shown():
        message = f"{one.text} is a difference of two directions and up to {largest:.3g} rad; a whole turn less, which"
        message += " is the same, is observed otherwise"
        yield RuleFinding(
            RULE, message, {"element": one.text, "value": largest, "expected": "up to pi"}, where=one.where
        )
        return
