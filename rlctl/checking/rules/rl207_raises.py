"""RL207: raises."""

import itertools
from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.failures import select_failures
from rlctl.checking.instance import lacks_display
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

NO_SEED = "got an unexpected keyword argument 'seed'"  # what reset raises where a wrapper passes it on


@judges_records(RULE)
def _find_exceptions(records: Records) -> Iterator[RuleFinding]:
    raised = (failure for failure in select_failures(records, "raised") if failure.file is None)  # the others: RL007
    takes_no_seed = records.built is not None and not records.built.accepts_seed  # RL202
    raised = (failure for failure in raised if not lacks_display(failure.error))  # RL216
    own = (failure for failure in raised if not (takes_no_seed and NO_SEED in failure.error))
    for failure in itertools.islice(own, 3):
        yield RuleFinding(RULE, failure.message, failure.place, fix=failure.fix, where=failure.where)
