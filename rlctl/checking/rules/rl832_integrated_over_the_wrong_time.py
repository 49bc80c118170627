"""RL832: integrated over the wrong time."""

import math
from collections.abc import Iterator

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity
from rlctl.checking.step_times import find_rates, find_step_times

RULE = Rule(
    "RL832",
    "integrated over the wrong time",
    Severity.WARNING,
    meaning="""
        In a robot without an engine a position or an angle changes by its velocity times another time than all others
        do: by the time of a whole step in each of its substeps, or by that of one substep in a whole step. It moves
        so many times faster or slower than its velocity says. How long a step takes is what the robot declares, as
        `dt` and `substeps`, and what its other positions and velocities confirm.
    """,
    fix="Integrate everything with the time of the loop that it is in: the substep's time inside the loop of substeps.",
)

NEAR = 0.1  # relative error of a time that is estimated


@judges_records(RULE, "attributes")
def _find_wrong_integration(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    if np.isfinite(log.physics_s):
        raise NotApplicable("an engine integrates")
    times = find_step_times(log)
    if times is None:
        raise NotApplicable("no step has several substeps, as far as it is known")
    rates = find_rates(log, log.values)
    if not any(math.isclose(seconds, times.control_s, rel_tol=NEAR) for _, _, seconds in rates):
        return
    for column, rate, seconds in rates:
        factor = seconds / times.control_s
        if any(math.isclose(factor, wrong, rel_tol=NEAR) for wrong in (times.substeps, 1 / times.substeps)):
            name, speed = log.names[column], log.names[rate]
            wrong_s = times.control_s if factor > 1 else times.physics_s
            message = (
                f"{name} changes in a step by {speed} times {seconds:.3g} s, {factor:.3g} times the"
                f" {times.control_s:.4g} s that a step takes ({times.source}): it is integrated with {wrong_s:.4g} s"
            )
            yield RuleFinding(RULE, message, {"element": name, "value": seconds, "expected": times.control_s})
            return
