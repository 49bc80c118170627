"""How long a step takes, and a step of the physics in it: from the engine, or from what a robot in NumPy declares."""

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.attributes import RATES, AttributeLog, Numbers
from rlctl.checking.rule import NotApplicable
from rlctl.checking.term_names import split_name

SUBSTEP_WORDS = {"substeps", "substep", "decimation", "skip", "frameskip", "repeat", "inner"}
"""Of names that say how many steps of the physics a step has."""
TIME_WORDS = {"dt", "timestep", "step"}
SHORT_TIME_WORDS = {"h", "ts"}  # of times, where nothing is called by the others
MOST_SUBSTEPS = 200
LEAST_MOTION = 1e-6
SAME = 0.99  # correlation of a change and of what changes by it
NEAR = 0.25  # relative error of a time that is estimated from positions and velocities
EXACT = 1e-3
MOVING, VARIES = 0.1, 0.2  # parts of the largest speed that count, and of the mean by which speeds have to differ
CLOSE, USUAL = 0.05, 0.9  # relative error of a time, and part of the steps in which it is so small
CLOSE_SIZE, USUAL_SIZE = 0.1, 0.75  # the same of a speed forwards: it changes within a step, and robots slip
FEWEST_STEPS = 20
MOST_COMPARED = 40  # attributes of which lengths are compared
UNIT = 1e-6  # how far from 1 the length of a quaternion may be


@dataclasses.dataclass(frozen=True)
class StepTimes:
    """Times of a robot with several steps of the physics in each step."""

    control_s: float  # of a step
    physics_s: float  # of a step of the physics
    source: str  # that says so: `MuJoCo`, or names of attributes

    @property
    def substeps(self) -> int:
        """How many steps of the physics a step has."""
        return round(self.control_s / self.physics_s)


def require_step_times(log: AttributeLog) -> StepTimes:
    """Return the times of a robot.

    Raises `NotApplicable` where they are not known, and where each step has one step of the physics.
    """
    times = _read_engine(log) if math.isfinite(log.physics_s) else _read_declared(log)
    if times is None or times.substeps <= 1:
        raise NotApplicable("no step has several steps of the physics, as far as it is known")
    return times


def _read_engine(log: AttributeLog) -> StepTimes | None:
    control_s = float(np.median(log.changes(log.seconds[:, None]))) if log.is_step.any() else 0.0
    is_whole = log.physics_s > 0 and math.isclose(
        control_s / log.physics_s, round(control_s / log.physics_s), abs_tol=0.01
    )
    return StepTimes(control_s, log.physics_s, "the engine") if is_whole and control_s > 0 else None


def _read_declared(log: AttributeLog) -> StepTimes | None:
    """Return the two times of which what is declared says one, and how positions follow velocities shows which."""
    declared = find_declared(log)
    if declared is not None and declared.control_s is not None:
        return StepTimes(declared.control_s, declared.control_s / declared.substeps, f"the source and {declared.count}")
    shown = estimate_step(log) if declared is not None else None
    if declared is None or shown is None:
        return None
    for name, value in declared.times.items():
        for control_s in (value, value * declared.substeps):
            # The other one is at least twice as long.
            if abs(shown / control_s - 1) < NEAR:
                return StepTimes(control_s, control_s / declared.substeps, f"{name} and {declared.count}")
    return None


@dataclasses.dataclass(frozen=True)
class DeclaredTimes:
    """What a robot without an engine declares."""

    count: str  # The name of the number of substeps
    substeps: int
    times: dict[str, float]  # of a step or of a substep, by name [s]
    control_s: float | None  # of a step, where the source says which of both a time is [s]


def find_declared(log: AttributeLog) -> DeclaredTimes | None:
    """Return the declared number of substeps, and times; None where there are none, or several numbers."""
    named = {
        name: round(value)
        for name, value in log.declared.items()
        if set(words_of(name)) & SUBSTEP_WORDS and 1 < value <= MOST_SUBSTEPS and value == round(value)
    }
    # A module may have constants of another robot.
    counts = {name: count for name, count in named.items() if name.startswith("self.")} or named
    counts = counts or {name: count for name, count in log.repeats.items() if count <= MOST_SUBSTEPS}
    times = _list_times(log, TIME_WORDS) or _list_times(log, SHORT_TIME_WORDS)
    times |= {name: 1 / log.declared[name] for name in RATES if log.declared.get(name, 0) > 1}
    if len(set(counts.values())) != 1 or not times:
        return None
    count, substeps = next(iter(counts.items()))
    known = {value for value in times.values() for other in times.values() if _is_part(other, value, substeps)}
    known |= {value for value in log.control_times if any(_are_times(value, t, substeps) for t in times.values())}
    return DeclaredTimes(count, substeps, times, known.pop() if len(known) == 1 else None)


def _is_part(part: float, whole: float, count: int) -> bool:
    return math.isclose(part * count, whole, rel_tol=EXACT)


def _are_times(whole: float, time: float, count: int) -> bool:
    return math.isclose(whole, time, rel_tol=EXACT) or _is_part(time, whole, count)


def _list_times(log: AttributeLog, words: set[str]) -> dict[str, float]:
    return {name: value for name, value in log.declared.items() if set(words_of(name)) & words and 0 < value < 1}


def words_of(name: str) -> list[str]:
    """Return the words of the last part of a name: of `self.cfg['gait_period'][0]` these are `gait` and `period`."""
    name = re.sub(r"(\[\d+\])+$", "", name)
    last = name.rpartition(".")[2].rpartition("[")[2] or name
    return split_name(last)


def estimate_step(log: AttributeLog) -> float | None:
    """Return how long a step takes by what changes by its velocity, among attributes and in the observation [s]."""
    found: list[float] = []
    for rows in (log.values, log.observed):
        found += [seconds for _, _, seconds in find_rates(log, rows)]
    if not found:
        return None
    median = float(np.median(found))
    return median if np.mean(np.abs(np.array(found) / median - 1) < NEAR) > 0.5 else None


def find_rates(log: AttributeLog, rows: Numbers) -> list[tuple[int, int, float]]:
    """Return which column changes by which other one, and by how much of it in each step [s]."""
    steps = np.flatnonzero(log.is_step)
    changes = log.changes(rows)
    if len(steps) < 10 or not rows.shape[1]:
        return []
    moving = changes.std(axis=0) > LEAST_MOTION
    best = np.zeros((rows.shape[1], rows.shape[1]))
    seconds = np.zeros_like(best)
    usual = np.abs(changes) <= np.quantile(np.abs(changes), 0.97, axis=0)  # angles wrap now and then
    kept = np.where(usual, changes, 0.0)
    for rates in (rows[steps], rows[steps - 1], (rows[steps] + rows[steps - 1]) / 2):
        sizes = np.einsum("nq,ne->qe", usual.astype(float), np.square(rates))
        products = np.einsum("nq,ne->qe", kept, rates)
        correlation = products / np.maximum(np.linalg.norm(kept, axis=0)[:, None] * np.sqrt(sizes), 1e-300)
        is_better = correlation > best
        best = np.where(is_better, correlation, best)
        seconds = np.where(is_better, products / np.maximum(sizes, 1e-300), seconds)
    np.fill_diagonal(best, 0.0)
    rate_of = best.argmax(axis=1)
    return [
        (column, int(rate), float(seconds[column, rate]))
        for column, rate in enumerate(rate_of.tolist())
        if moving[column] and best[column, rate] > SAME and seconds[column, rate] > 0
    ]


@dataclasses.dataclass(frozen=True)
class NamedRate:
    """An attribute that changes by another one times a time."""

    name: str
    rate: str
    seconds: float  # in each step [s]


def list_named_rates(log: AttributeLog) -> list[NamedRate]:
    """Return which attributes change by which others, and which pairs of them are as long a way as others are fast: a
    place in the world's axes and a velocity in those of the robot."""
    single = [NamedRate(log.names[column], log.names[rate], s) for column, rate, s in find_rates(log, log.values)]
    rates = {one.name for one in single} | {one.rate for one in single}
    free = [column for column in range(len(log.names)) if log.names[column] not in rates]
    pairs = [(column, other, 2) for column in free for other in free if column + 1 in free and other + 1 in free]
    places = [c for c in range(min(MOST_COMPARED, len(log.names)) - 1) if _are_neighbours(log, c)]
    pairs += [(column, other, 1) for column in places for other in range(min(MOST_COMPARED, len(log.names)))]
    lengths = [
        NamedRate(_name_pair(log, column), _name_size(log, other, size), seconds)
        for column, other, size, seconds in _find_lengths(log, pairs)
    ]
    return [*single, *lengths, *_find_turns(log)]


def _are_neighbours(log: AttributeLog, column: int) -> bool:
    return log.names[column].rpartition("[")[0] == log.names[column + 1].rpartition("[")[0]


def _name_pair(log: AttributeLog, column: int) -> str:
    return f"({log.names[column]}, {log.names[column + 1]})"


def _name_size(log: AttributeLog, column: int, size: int) -> str:
    return f"the length of {_name_pair(log, column)}" if size > 1 else f"the size of {log.names[column]}"


def _find_lengths(log: AttributeLog, pairs: Sequence[tuple[int, int, int]]) -> Iterator[tuple[int, int, int, float]]:
    """Yield which two columns move by the length of which one or two others, and for how long [s]; of pairs of first
    columns, with how many columns the second has."""
    steps = np.flatnonzero(log.is_step)
    changes, middle = log.changes(log.values), (log.values[steps] + log.values[steps - 1]) / 2
    if len(steps) < FEWEST_STEPS:
        return
    for column, other, size in pairs:
        if other + size <= column or other >= column + 2:
            way = np.linalg.norm(changes[:, column : column + 2], axis=1)
            limits = (CLOSE, USUAL) if size > 1 else (CLOSE_SIZE, USUAL_SIZE)
            seconds = _find_factor(way, np.linalg.norm(middle[:, other : other + size], axis=1), *limits)
            if seconds is not None:
                yield column, other, size, seconds


def _find_turns(log: AttributeLog) -> Iterator[NamedRate]:
    """Yield which quaternion turns by which angular velocity."""
    steps = np.flatnonzero(log.is_step)
    if len(steps) < FEWEST_STEPS:
        return
    middle = (log.values[steps] + log.values[steps - 1]) / 2
    for column in range(log.values.shape[1] - 3):
        quaternions = log.values[:, column : column + 4]
        if np.abs(np.linalg.norm(quaternions, axis=1) - 1).max() > UNIT:
            continue
        cosines = np.abs(np.einsum("ni,ni->n", quaternions[steps], quaternions[steps - 1]))
        angles = 2 * np.arccos(np.clip(cosines, 0.0, 1.0))
        for other in range(log.values.shape[1] - 2):
            if column - 3 < other < column + 4:
                continue
            seconds = _find_factor(angles, np.linalg.norm(middle[:, other : other + 3], axis=1))
            if seconds is not None:
                rate = f"({log.names[other]} to {log.names[other + 2]})"
                yield NamedRate(f"the turn of ({log.names[column]} to {log.names[column + 3]})", rate, seconds)


def _find_factor(ways: Numbers, speeds: Numbers, near: float = CLOSE, usual: float = USUAL) -> float | None:
    """Return by which time speeds have to be multiplied to be ways, if it is nearly always the same [s]."""
    is_fast = speeds > MOVING * speeds.max(initial=0.0)
    if speeds.std() < VARIES * speeds.mean() or is_fast.sum() < FEWEST_STEPS:
        return None
    times = ways[is_fast] / speeds[is_fast]
    seconds = float(np.median(times))
    is_same = seconds > LEAST_MOTION and np.mean(np.abs(times / seconds - 1) < near) > usual
    return seconds if is_same else None
