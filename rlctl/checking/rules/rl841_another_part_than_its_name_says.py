"""RL841: another part than its name says."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.named_parts import find_named_otherwise
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL841",
    "another part than its name says",
    Severity.WARNING,
    meaning="""
        The source looks a link, a joint or a geom up by its name, and calls it otherwise: foot for what is a shin
        though there is a foot, left for what is right. Or a list names one part twice, and its counterpart never.
        Contacts, distances and velocities are then those of another part.
    """,
    fix="Look each part up by its own name.",
)


@judges_expressions(RULE)
def _find_other_parts(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from itertools.islice(find_named_otherwise(RULE, noted), 1)
