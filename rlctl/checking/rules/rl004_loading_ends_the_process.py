"""RL004: loading ends the process."""

from collections.abc import Iterator

from rlctl.checking.experiment import PROBE, judges_records
from rlctl.checking.instance import display_error
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL004",
    "loading ends the process",
    Severity.ERROR,
    meaning="Importing or building the environment crashes the interpreter, ends it, or never returns.",
    fix="""
        `python -X faulthandler -c 'import rlctl; rlctl.make("TASK")'` shows where it stops. Nothing at import
        or in the constructor may wait for input, open a window, or exit.
    """,
    needs_instance=False,
)


@judges_records(RULE, "build")
def _find_end_while_loading(records: Records) -> Iterator[RuleFinding]:
    if records.built is None:
        for failure in records.failures:
            if failure.process == PROBE and failure.call in ("load", "build") and not display_error(failure):
                evidence = {"last_output": failure.details} if failure.details else {}
                yield RuleFinding(RULE, failure.message, evidence)
