"""RL202: reset takes no seed."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL202",
    "reset takes no seed",
    Severity.ERROR,
    meaning="""
        reset has no `seed`, so no episode can be repeated, and every library that seeds fails at its first
        call.
    """,
    fix="def reset(self, *, seed=None, options=None): super().reset(seed=seed) ...",
)


@judges_records(RULE, "build")
def _find_reset_without_seed(records: Records) -> Iterator[RuleFinding]:
    if not records.require_built().accepts_seed:
        yield RuleFinding(RULE, "reset has no parameter `seed`")
