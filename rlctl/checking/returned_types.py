"""The types of what reset and step return, as they were recorded."""

from collections.abc import Iterator

from rlctl.checking.records import CheckedEpisode, Form, Records
from rlctl.checking.rule import Rule, RuleFinding, Severity


def list_first_forms(records: Records, what: str, *fine: str) -> Iterator[tuple[CheckedEpisode, Form]]:
    """Yield the first of each type that something had, without those that are fine."""
    types = set(fine)
    for trajectory, form in records.forms(what):
        if form.type not in types:
            types.add(form.type)
            yield trajectory, form


def report_form(
    rule: Rule, message: str, trajectory: CheckedEpisode, form: Form, expected: str, severity: Severity | None = None
) -> RuleFinding:
    """Return the finding that something has another type than expected."""
    call = "step" if form.step else "reset"
    return RuleFinding(rule, message, trajectory.at(form.step, call=call, type=form.type, expected=expected), severity)


def name_type(type_name: str) -> str:
    """Return a type's name with its article."""
    article = "an" if type_name[0] in "aeiou" else "a"
    return type_name if type_name == "NoneType" else f"{article} {type_name}"
