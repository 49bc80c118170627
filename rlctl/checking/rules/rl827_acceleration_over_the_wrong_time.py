"""RL827: acceleration over the wrong time."""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import AttributeLog, Numbers
from rlctl.checking.records import Records
from rlctl.checking.rewards import RAW_TERMS, TERMS
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.step_times import StepTimes, find_rates, require_step_times

RULE = Rule(
    "RL827",
    "acceleration over the wrong time",
    Severity.WARNING,
    meaning="""
        A term of the reward in info, another number of info or an attribute is an acceleration: how a velocity changed
        in a whole step, divided by the time of one step of the physics. It is too large by the number of physics steps
        in a step, and its square by the square of that. Which number the term is multiplied by is looked for in the
        source and among the attributes: it has to be there for the wrong time, and not for the right one.
    """,
    fix="Divide by the time between two actions: the physics step times frame_skip, which is self.dt of a MujocoEnv.",
    shows_one=True,
)

SAME = 1e-3  # relative, of weights
EXACT = 1e-4  # of what is left, relative
MOST_ROOTS = 7  # the first speeds, of a base, that a term may leave out
FEWEST_STEPS = 30
LEAST_MOTION = 1e-4


@dataclasses.dataclass(frozen=True, eq=False)
class _Form:
    """A quantity of the changes of velocities in a step."""

    what: str
    power: int  # of the time by which it is divided
    values: Numbers  # Shape (steps,)
    count: int  # of velocities


@judges_records(RULE, "attributes")
def _find_wrong_accelerations(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    times = require_step_times(log)
    speeds = _list_speeds(log)
    steps = np.flatnonzero(log.is_step)
    if len(steps) < FEWEST_STEPS:
        return
    for column, name in enumerate(log.names):
        if _is_change(log.values[steps, column], speeds, steps, times):
            message = f"{name} is the change of a velocity in a step, divided by {times.physics_s:.4g} s"
            yield _describe(name, message, times, 1)
            return
    weights = {1.0, *log.literals, *map(abs, log.declared.values())} - {0.0}
    forms = [form for group in speeds for form in _list_forms(group, steps)]
    is_raw = any(name.startswith(RAW_TERMS) for name in log.infos)
    for name, series in log.infos.items():
        values = series[steps]
        if is_raw and name.startswith(TERMS):
            continue  # the same without its weight tells it
        found = _match(name, values, forms, weights, times) if np.isfinite(values).all() and values.any() else None
        if found is not None:
            message = (
                f"{name} is {found.what} of the changes of velocities in a step, divided by {times.physics_s:.4g} s"
            )
            yield _describe(name, message, times, found.power)
            return


def _describe(name: str, message: str, times: StepTimes, power: int) -> RuleFinding:
    taken = f"the step takes {times.control_s:.4g} s, {times.substeps} steps of the physics"
    message = f"{message}; {taken}: it is {times.substeps**power} times too large"
    return RuleFinding(RULE, message, {"element": name, "value": times.physics_s, "expected": times.control_s})


def _list_speeds(log: AttributeLog) -> list[Numbers]:
    """Return velocities that may be meant together: of the engine, or attributes by which others change."""
    groups = [log.speeds] if log.speeds.shape[1] else []
    rates = sorted({rate for _, rate, _ in find_rates(log, log.values)})
    owners: dict[str, list[int]] = {}
    for rate in rates:
        owners.setdefault(log.names[rate].rpartition("[")[0] or log.names[rate], []).append(rate)
    groups += [log.values[:, columns] for columns in owners.values()]
    return [group[:, first:] for group in groups for first in range(min(MOST_ROOTS, group.shape[1]))]


def _list_forms(speeds: Numbers, steps: NDArray[np.intp]) -> Iterator[_Form]:
    before = steps - 1
    changes = speeds[steps] - speeds[before]
    yield _Form("the sum of squares", 2, np.square(changes).sum(axis=1), changes.shape[1])
    yield _Form("the sum of sizes", 1, np.abs(changes).sum(axis=1), changes.shape[1])
    yield _Form("the length", 1, np.linalg.norm(changes, axis=1), 1)


def _is_change(values: Numbers, speeds: Sequence[Numbers], steps: NDArray[np.intp], times: StepTimes) -> bool:
    before = steps - 1
    for group in speeds:
        changes = (group[steps] - group[before]) / times.physics_s
        off = np.abs(changes - values[:, None]).max(axis=0)
        if values.std() > LEAST_MOTION / times.physics_s and (off < EXACT * np.abs(values).max()).any():
            return True
    return False


def _match(name: str, values: Numbers, forms: Sequence[_Form], weights: set[float], times: StepTimes) -> _Form | None:
    """Return the form that values are, times a weight that is known, divided by the time of the physics."""
    for form in forms:
        size = float(form.values @ form.values)
        factor = float(values @ form.values) / size if size > 0 else 0.0
        if not factor or np.abs(values - factor * form.values).max() > EXACT * np.abs(values).max():
            continue
        known = {1.0} if name.startswith(RAW_TERMS) else weights
        right, wrong = (abs(factor) * s**form.power for s in (times.control_s, times.physics_s))
        counts = {1, form.count}
        if any(math.isclose(right * count, weight, rel_tol=SAME) for weight in known for count in counts):
            return None
        if any(math.isclose(wrong * count, weight, rel_tol=SAME) for weight in known for count in counts):
            return form
    return None
