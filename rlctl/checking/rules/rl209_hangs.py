"""RL209: hangs."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.failures import select_failures
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL209",
    "hangs",
    Severity.ERROR,
    meaning="A call into the environment does not return.",
    fix="""
        Find what it waits for (input, a window, a lock, a connection); if it is only slow, raise --env-timeout.
    """,
)


@judges_records(RULE)
def _find_hangs(records: Records) -> Iterator[RuleFinding]:
    for failure in itertools.islice(select_failures(records, "hung"), 1):
        yield RuleFinding(RULE, failure.message, failure.place)
