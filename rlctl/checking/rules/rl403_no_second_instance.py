"""RL403: no second instance."""

from collections.abc import Iterator

from rlctl.checking.experiment import PROBE, judges_records
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL403",
    "no second instance",
    Severity.ERROR,
    meaning="""
        A second environment, in the same process or in another at the same time, cannot be built. Training
        needs many.
    """,
    fix="""
        Open nothing exclusive (a port, a file, a display) in the constructor, or choose a free one per
        instance.
    """,
)


@judges_records(RULE, "instances")
def _find_single_instance(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if failure.call in ("load", "build") and failure.process != PROBE:
            where = "in one process" if failure.phase in ("fresh instance", "interleaved") else "in a second process"
            yield RuleFinding(RULE, f"a second instance {where} cannot be built: {failure.error}", failure.place)
            return
