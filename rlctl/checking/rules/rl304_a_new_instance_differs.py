"""RL304: a new instance differs."""

from collections.abc import Iterator

from rlctl.checking.differences import compare_other
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL304",
    "a new instance differs",
    Severity.ERROR,
    meaning="""
        A second instance in the same process gives another trajectory with the same seed and actions. The
        instances share something: a class attribute, a module's global, a simulator that close leaves open.
    """,
    fix="""
        Keep state in self, not in the class or the module; close what the constructor opens; pass
        physicsClientId.
    """,
    shows_one=True,
)


@judges_records(RULE, "comparisons", "instances")
def _compare_instances(records: Records) -> Iterator[RuleFinding]:
    return compare_other(RULE, records, "fresh process", "fresh instance", "played by a second instance in one process")
