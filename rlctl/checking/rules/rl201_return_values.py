"""RL201: return values."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.returned_types import list_first_forms, name_type, report_form
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL201",
    "return values",
    Severity.ERROR,
    meaning="""
        reset or step does not return as many values as Gymnasium's interface demands. Four values from step are
        the old `gym`: its single `done` cannot tell a failure from a time limit.
    """,
    fix="reset returns (observation, info); step returns (observation, reward, terminated, truncated, info).",
)


@judges_records(RULE)
def _find_other_number_of_values(records: Records) -> Iterator[RuleFinding]:
    for what, expected in (("reset", "tuple of 2"), ("step", "tuple of 5")):
        for trajectory, form in list_first_forms(records, what):
            yield report_form(RULE, f"{what} returns {name_type(form.type)}", trajectory, form, expected)
