"""RL402: closing breaks another instance."""

from collections.abc import Iterator

from rlctl.checking.differences import compare, report
from rlctl.checking.experiment import judges_records
from rlctl.checking.neighbours import find_failure, require_same_alone
from rlctl.checking.records import Records
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.rules.rl401_instances_share_a_world import find_shared_world

RULE = Rule(
    "RL402",
    "closing breaks another instance",
    Severity.ERROR,
    meaning="""
        Closing one instance breaks another or changes its behaviour: close ends something that both use.
    """,
    fix="""
        Give each instance its own state. With PyBullet: keep the id that p.connect returned and pass
        physicsClientId=self.client to every call, p.disconnect included.
    """,
)

AFTER_CLOSE = "after another instance was closed"


@judges_records(RULE, "comparisons", "instances")
def _find_effect_of_closing(records: Records) -> Iterator[RuleFinding]:
    require_same_alone(records)
    if finding := find_failure(records, RULE, "after close", AFTER_CLOSE):
        yield finding
        return
    if list(find_shared_world.run(records)):
        raise NotJudged("the instances already affect each other before one is closed (RL401)")
    if (difference := compare(records, "second alone", "after close")) is not None:
        yield report(RULE, records, difference, f"{AFTER_CLOSE}, compared with one alone")
