"""RL831: steps of the physics are missing."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import RATES, AttributeLog
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity
from rlctl.checking.step_times import words_of

RULE = Rule(
    "RL831",
    "steps of the physics are missing",
    Severity.WARNING,
    meaning="""
        A step of the environment simulates another time than the environment declares: by its frame rate or its control
        time, which is so many steps of the physics, and a number of steps that it names. The loop over the steps of
        the physics is missing, or runs twice. Velocities, time limits and penalties that are computed with the
        declared time are wrong, and the robot that is trained is faster or slower than the real one.
    """,
    fix="Call the physics in each step as often as the declared number says, or declare the time that a step takes.",
)

EXACT = 1e-3  # relative
COUNT_WORDS = {"substeps", "substep", "skip", "decimation", "repeat", "frames", "inner", "sub", "steps"}
OTHER_WORDS = {"max", "limit", "episode", "horizon", "length", "total", "history"}
TIME_WORDS = {"dt", "timestep", "control", "ctrl", "step", "period"}
RATE_WORDS = {"hz", "freq", "frequency", "rate", "fps"}
MOST = 1_000  # steps of the physics in a step
LEAST_STEPS = 20


@judges_records(RULE, "attributes")
def _find_missing_steps(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    if not np.isfinite(log.physics_s):
        raise NotApplicable("no engine that counts its time")
    seconds = log.changes(log.seconds[:, None])[:, 0]
    simulated_s = float(np.median(seconds)) if len(seconds) else 0.0
    if len(seconds) < LEAST_STEPS or simulated_s <= 0 or np.ptp(seconds) > EXACT * simulated_s:
        return
    times = _list_times(log.declared)
    counts = {name: value for name, value in log.declared.items() if _is_count(name, value)}
    is_one = math.isclose(simulated_s, log.physics_s, rel_tol=EXACT)  # the time of the physics is often declared too
    if not is_one and any(math.isclose(one, simulated_s, rel_tol=EXACT) for one in times.values()):
        return
    if any(math.isclose(one * log.physics_s, simulated_s, rel_tol=EXACT) for one in counts.values()):
        return
    for name, declared_s in times.items():
        count = declared_s / log.physics_s
        fitting = [other for other, value in counts.items() if value > 1 and math.isclose(value, count, rel_tol=EXACT)]
        if fitting:
            message = (
                f"a step simulates {simulated_s:.4g} s, {simulated_s / log.physics_s:.4g} of {log.physics_s:.4g} s;"
                f" {name} is {_format(name, log.declared[name])}, and {fitting[0]} is {count:.0f}: that is"
                f" {declared_s:.4g} s"
            )
            yield RuleFinding(RULE, message, {"element": fitting[0], "value": simulated_s, "expected": declared_s})
            return


def _format(name: str, value: float) -> str:
    return f"{value:.4g} Hz" if _is_rate(name) else f"{value:.4g} s"


def _is_rate(name: str) -> bool:
    return name in RATES or bool(set(words_of(name)) & RATE_WORDS)


def _list_times(declared: Mapping[str, float]) -> dict[str, float]:
    """Return what may be the time of a step of the environment, by name [s]."""
    times = {}
    for name, value in declared.items():
        if value > 0 and _is_rate(name):
            times[name] = 1 / value
        elif value > 0 and set(words_of(name)) & TIME_WORDS and value < 1:
            times[name] = value
    return times


def _is_count(name: str, value: float) -> bool:
    words = set(words_of(name))
    is_whole = 1 <= value <= MOST and value == round(value)  # not infinite
    return is_whole and bool(words & COUNT_WORDS) and not words & OTHER_WORDS
