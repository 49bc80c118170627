"""RL401: instances share a world."""

from collections.abc import Iterator

from rlctl.checking.differences import compare, report
from rlctl.checking.experiment import judges_records
from rlctl.checking.neighbours import find_failure, require_same_alone
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.rules.rl309_global_random_generator import RULE as GLOBAL_RANDOM
from rlctl.checking.rules.rl808_physicsclientid_left_out import RULE as NO_CLIENT

RULE = Rule(
    "RL401",
    "instances share a world",
    Severity.ERROR,
    meaning="""
        Two instances stepped in turns behave differently from one alone. They share a simulation or other
        state, so the environments of a training disturb each other.
    """,
    fix="""
        Give each instance its own state. With PyBullet: keep the id that p.connect returned and pass
        physicsClientId=self.client to every call, p.disconnect included.
    """,
)

IN_TURNS = "two instances stepped alternately"


@judges_records(RULE, "comparisons", "global random", "instances")
def find_shared_world(records: Records) -> Iterator[RuleFinding]:
    """Yield that an instance behaves otherwise when it is stepped in turns with another one."""
    require_same_alone(records)
    if finding := find_failure(records, RULE, "interleaved", IN_TURNS):
        yield finding
        return
    for alone, beside in (("fresh process", "interleaved"), ("second alone", "interleaved second")):
        if (difference := compare(records, alone, beside)) is not None:
            because, fix = _find_cause(records)
            yield report(RULE, records, difference, f"{IN_TURNS}, compared with one alone", because, fix)
            return


def _find_cause(records: Records) -> tuple[str, str]:
    """Return what both share, as far as other rules have found it, and how to mend it."""
    found = {finding.rule for finding in records.findings}
    if {NO_CLIENT.id, GLOBAL_RANDOM.id} <= found:  # Either may be the cause.
        return "; both use PyBullet's client 0 (RL808), and draw from a global random generator (RL309)", ""
    if NO_CLIENT.id in found:
        return "; both use PyBullet's client 0 (RL808)", ""
    if GLOBAL_RANDOM.id in found:
        return "; both draw from a global random generator (RL309)", GLOBAL_RANDOM.fix
    return "", ""
