"""RL207: raises."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.failures import select_failures
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL207",
    "raises",
    Severity.ERROR,
    meaning="A call into the environment raises with actions from its own action space. Training ends there.",
    fix="Repeat the episode with this seed and these actions, and repair what raises.",
    allows_old_gym=True,
)


@judges_records(RULE)
def _find_exceptions(records: Records) -> Iterator[RuleFinding]:
    raised = (failure for failure in select_failures(records, "raised") if failure.file is None)  # the others: RL007
    for failure in itertools.islice(raised, 3):
        yield RuleFinding(RULE, failure.message, failure.place, fix=failure.fix, where=failure.where)
