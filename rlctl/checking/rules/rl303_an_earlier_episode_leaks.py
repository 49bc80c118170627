"""RL303: an earlier episode leaks."""

from collections.abc import Iterator

from rlctl.checking.differences import compare_other
from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL303",
    "an earlier episode leaks",
    Severity.ERROR,
    meaning="""
        After an unfinished episode with other actions, the same seed gives another trajectory: reset leaves
        something of the earlier episode, so episodes are not independent. A warning if the first tens of steps
        agree, or if the difference is a numerical residue.
    """,
    fix="""
        Reset every attribute that step changes; in a simulation also velocities, contacts and motor targets (a
        full resetSimulation, or a state saved right after loading).
    """,
    shows_one=True,
)


@judges_records(RULE, "comparisons")
def _compare_after_other(records: Records) -> Iterator[RuleFinding]:
    return compare_other(RULE, records, "alone", "dirty", "played again after an unfinished other episode")
