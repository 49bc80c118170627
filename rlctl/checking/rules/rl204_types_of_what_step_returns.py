"""RL204: types of what step returns."""

from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.records import Records
from rlctl.checking.returned_types import list_first_forms, name_type, report_form
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.environments.success import SUCCESS

RULE = Rule(
    "RL204",
    "types of what step returns",
    Severity.ERROR,
    meaning="""
        terminated or truncated is not a bool, the reward is not a float, or info is not a dict. An array or
        None as a reward fails or broadcasts, and wrappers write into info. An info for numpy.bool flags and
        numpy rewards: training works, but `terminated is True` is false, and Stable-Baselines3's checker
        refuses them. A warning if is_success in info is neither true nor false: rlctl counts every number above
        0 as success.
    """,
    fix="""
        Return bool(...) for both flags (a comparison of numpy numbers gives numpy.bool), float(reward), and a
        dict, which may be empty.
    """,
)

NUMBERS = ("float", "int", "numpy.float64")  # Reward types that both libraries accept


@judges_records(RULE)
def _find_wrong_types(records: Records) -> Iterator[RuleFinding]:
    for what in ("terminated", "truncated"):
        for trajectory, form in list_first_forms(records, what, "bool"):
            message = f"{what} is {name_type(form.type)} at step {form.step}"
            severity = Severity.INFO if form.type in ("numpy.bool", "numpy.bool_") else None
            yield report_form(RULE, message, trajectory, form, "bool", severity)
    for trajectory, form in list_first_forms(records, "reward", *NUMBERS):
        is_number = form.type.startswith(("numpy.float", "numpy.int", "numpy.uint"))
        message = f"the reward is {name_type(form.type)} at step {form.step}"
        yield report_form(RULE, message, trajectory, form, "float", Severity.INFO if is_number else None)
    for trajectory, form in list_first_forms(records, "info", "dict"):
        yield report_form(RULE, f"info is {name_type(form.type)} at step {form.step}", trajectory, form, "dict")
    for trajectory in records.require_alone():
        if (success := trajectory.infos.get(SUCCESS)) and not np.isin(success.values, (0, 1)).all():
            at = int(np.isin(success.values, (0, 1)).argmin())
            value, step = float(success.values[at]), int(success.steps[at])
            evidence = trajectory.at(step, element=SUCCESS, value=value, expected="true or false")
            fix = f"Report bool(...) as info['{SUCCESS}']."
            yield RuleFinding(RULE, f"{SUCCESS} is {value:.4g} at step {step}", evidence, Severity.WARNING, fix)
            return
