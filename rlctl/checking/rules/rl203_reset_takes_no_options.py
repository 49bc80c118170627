"""RL203: reset takes no options."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL203",
    "reset takes no options",
    Severity.WARNING,
    meaning="reset has no `options`; Gymnasium's wrappers pass it and fail.",
    fix="def reset(self, *, seed=None, options=None): ...",
)


@judges_records(RULE, "build")
def _find_reset_without_options(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    if built.accepts_seed and not built.accepts_options:  # without `seed`, RL202 says what reset has to look like
        yield RuleFinding(RULE, "reset has no parameter `options`")
