"""RL832: integrated over the wrong time."""

import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity
from rlctl.checking.step_times import NamedRate, find_declared, list_named_rates

RULE = Rule(
    "RL832",
    "integrated over the wrong time",
    Severity.WARNING,
    meaning="""
        In a robot without an engine a position or an angle changes by its velocity times another time than all others
        do: by the time of a whole step in each of its substeps, or by that of one substep in a whole step. It moves
        so many times faster or slower than its velocity says. How long a step takes is what the robot declares, as
        `dt` and `substeps` or by a loop of its step, and what its other positions and velocities confirm.
    """,
    fix="Integrate everything with the time of the loop that it is in: the substep's time inside the loop of substeps.",
)

NEAR = 0.1  # relative error of a time that is estimated


@judges_records(RULE, "attributes")
def _find_wrong_integration(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    if np.isfinite(log.physics_s):
        raise NotApplicable("an engine integrates")
    declared = find_declared(log)
    if declared is None:
        raise NotApplicable("no step has several substeps, as far as it is known")
    rates = list_named_rates(log)
    for name, declared_s in declared.times.items():
        for control_s in (declared_s, declared_s * declared.substeps):
            right = [pair for pair in rates if math.isclose(pair.seconds, control_s, rel_tol=NEAR)]
            for factor in (declared.substeps, 1 / declared.substeps) if right else ():
                wrong = [pair for pair in rates if math.isclose(pair.seconds, factor * control_s, rel_tol=NEAR)]
                if wrong and len(wrong) <= len(right):
                    yield _describe(
                        wrong[0], right[0], f"{name} is {declared_s:.3g} s, {declared.count} {declared.substeps}"
                    )
                    return


def _describe(wrong: NamedRate, right: NamedRate, declared: str) -> RuleFinding:
    one, two = (f"{each.name} changes by {each.rate} times {each.seconds:.3g} s" for each in (wrong, right))
    message = f"in a step {one}, and {two}: {declared}"
    return RuleFinding(RULE, message, {"element": wrong.name, "value": wrong.seconds, "expected": right.seconds})
