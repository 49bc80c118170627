"""RL832: integrated over the wrong time."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity
from rlctl.checking.step_times import DeclaredTimes, NamedRate, find_declared, list_named_rates
from rlctl.checking.timed_expressions import Use, find_wrong_time

RULE = Rule(
    "RL832",
    "integrated over the wrong time",
    Severity.WARNING,
    meaning="""
        A line of the source adds a rate times the time of a whole step in each of its substeps, or times that of one
        substep once in a step; or it shows in the motion: in a robot without an engine a position or an angle changes
        by its velocity times another time than all others do: by the time of a whole step in each of its substeps, or
        by that of one substep in a whole step. It moves so many times faster or slower than its velocity says. How long
        a step takes is what the robot declares, as `dt` and `substeps` or by a loop of its step, and what its other
        positions and velocities confirm; or the source divides the time of a step by the number of substeps, or
        multiplies that of a substep by it.
    """,
    fix="Integrate everything with the time of the loop that it is in: the substep's time inside the loop of substeps.",
)

NEAR, ALONE = 0.1, 0.03  # relative errors of a time that is estimated; the same where no other one confirms it


@judges_records(RULE, "attributes", "expressions")
def _judge(records: Records) -> Iterator[RuleFinding]:
    for timed, times in find_wrong_time(records, Use.INTEGRATED):
        often = "once" if timed.most == 1 else f"{timed.most} times"
        message = f"{timed.text} is evaluated {often} in a step, with {timed.seconds:.3g} s: {timed.target} advances by"
        message += f" {timed.total_s:.3g} s in a step that takes {times.control_s:.3g} s"
        evidence = {"element": timed.target, "value": timed.total_s, "expected": times.control_s}
        yield RuleFinding(RULE, message, evidence, where=timed.where)
        return
    yield from _find_wrong_integration(records)


def _find_wrong_integration(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    if np.isfinite(log.physics_s):
        raise NotApplicable("an engine integrates")
    declared = find_declared(log)
    if declared is None:
        raise NotApplicable("no step has several substeps, as far as it is known")
    rates = list_named_rates(log)
    if declared.control_s is not None:
        yield from _compare(rates, declared, declared.control_s)
        return
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


def _compare(rates: Sequence[NamedRate], declared: DeclaredTimes, control_s: float) -> Iterator[RuleFinding]:
    """Yield a change by another time than that of a step, which is known."""
    right = [pair for pair in rates if math.isclose(pair.seconds, control_s, rel_tol=NEAR)]
    for factor in (declared.substeps, 1 / declared.substeps):
        near = NEAR if right else ALONE
        wrong = [pair for pair in rates if math.isclose(pair.seconds, factor * control_s, rel_tol=near)]
        if wrong:
            said = f"a step takes {control_s:.3g} s, {declared.count} is {declared.substeps}"
            yield _describe(wrong[0], right[0] if right else None, said)
            return


def _describe(wrong: NamedRate, right: NamedRate | None, declared: str) -> RuleFinding:
    shown = [f"{pair.name} changes by {pair.rate} times {pair.seconds:.3g} s" for pair in (wrong, right) if pair]
    evidence = {"element": wrong.name, "value": wrong.seconds}
    expected = {"expected": right.seconds} if right is not None else {}
    return RuleFinding(RULE, f"in a step {', and '.join(shown)}: {declared}", evidence | expected)
