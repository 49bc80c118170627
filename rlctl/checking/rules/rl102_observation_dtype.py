"""RL102: observation dtype."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.observations import list_forms, name_moment
from rlctl.checking.records import Form, Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.leaves import Leaf, name_leaf

RULE = Rule(
    "RL102",
    "observation dtype",
    Severity.WARNING,
    meaning="""
        An observation does not have the dtype of its space. The checkers of Gymnasium and Stable-Baselines3
        refuse it, and libraries convert it and lose digits. An error if it is not a number.
    """,
    fix="Convert with np.asarray(..., dtype=self.observation_space.dtype) before returning.",
)


@judges_records(RULE)
def _find_wrong_dtype(records: Records) -> Iterator[RuleFinding]:
    wrong = [record for record in list_forms(records) if _has_wrong_dtype(record[1], record[3])]
    parts = len({index for index, *_ in wrong})
    for _, leaf, trajectory, form in wrong[:1]:
        more = f"; {parts - 1} other parts differ too" if parts > 1 else ""
        message = f"{name_leaf(leaf)} {name_moment(form.step)} is {form.dtype}; the space is {leaf.dtype}{more}"
        evidence = trajectory.at(form.step, dtype=form.dtype, expected=leaf.dtype)
        is_number = np.dtype(form.dtype).kind in "biuf"
        yield RuleFinding(RULE, message, evidence, Severity.WARNING if is_number else Severity.ERROR)


def _has_wrong_dtype(leaf: Leaf, form: Form) -> bool:
    if form.dtype is None or form.shape != leaf.shape or form.type in ("list", "tuple"):
        return False
    dtype, declared = np.dtype(form.dtype), np.dtype(leaf.dtype)
    if leaf.kind != "Box":
        return dtype.kind not in "iub"
    return dtype != declared and not (form.type in ("float", "int") and leaf.shape == ())
