"""RL101: observation shape."""

from collections.abc import Iterator

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import list_forms, name_moment
from rlctl.checking.records import Form, Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.leaves import Leaf, name_leaf

RULE = Rule(
    "RL101",
    "observation shape",
    Severity.ERROR,
    meaning="""
        An observation does not have the structure of its space. Libraries copy observations into arrays made
        from the space: this fails or, worse, broadcasts.
    """,
    fix="Return arrays of the shape that observation_space declares, from reset and from every step.",
)


@judges_records(RULE)
def _find_wrong_shape(records: Records) -> Iterator[RuleFinding]:
    reported = set()
    for index, leaf, trajectory, form in list_forms(records):
        if index not in reported and (what := _wrong_shape(leaf, form)):
            reported.add(index)
            shape = None if form.shape is None else list(form.shape)
            message = f"{name_leaf(leaf)} {name_moment(form.step)} {what}"
            evidence = trajectory.at(form.step, type=form.type, shape=shape, expected=list(leaf.shape))
            yield RuleFinding(RULE, message, evidence)
    for trajectory, form in records.forms("keys")[:1]:
        message = f"observation has the keys {form.type}; the space has other keys"
        yield RuleFinding(RULE, message, trajectory.at(form.step))


def _wrong_shape(leaf: Leaf, form: Form) -> str:
    if form.type == "missing":
        return f"is missing; the space has shape {leaf.shape}"
    if form.shape != leaf.shape:
        what = f"has shape {form.shape}" if form.shape is not None else f"is not an array but a {form.type}"
        return f"{what}; the space has shape {leaf.shape}"
    return f"is a {form.type}, not a numpy array" if form.type in ("list", "tuple") else ""
