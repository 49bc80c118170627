"""RL305: a new process differs."""

from collections.abc import Iterator

from rlctl.checking.differences import compare_other
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL305",
    "a new process differs",
    Severity.ERROR,
    meaning="""
        A new process with another PYTHONHASHSEED gives another trajectory with the same seed and actions.
        Results cannot be repeated tomorrow.
    """,
    fix="""
        Look for the order of sets or hashes, os.environ, time, global generators seeded at import, and files
        that are read and written.
    """,
    shows_one=True,
)


@judges_records(RULE, "comparisons", "instances")
def _compare_processes(records: Records) -> Iterator[RuleFinding]:
    return compare_other(RULE, records, "alone", "fresh process", "played by a new process")
