"""RL134: degrees observed next to radians."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.observed_units import ObservedUnits
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL134",
    "degrees observed next to radians",
    Severity.WARNING,
    meaning="""
        The source puts an angle or a turn rate into the observation in degrees, and others in radians. It is 57 times
        as large as they are: a network that learns from both hardly sees the others, and a scale that was chosen for
        radians does not fit. Degrees that are divided by a range of about 10 or more do not count, nor those whose name
        says so.
    """,
    fix="Observe all angles in radians; the angular velocities of engines are in radians per second already.",
)


@judges_expressions(RULE, decides=False)
def _find_degrees(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from itertools.islice(ObservedUnits(noted).find_degrees(RULE), 1)
