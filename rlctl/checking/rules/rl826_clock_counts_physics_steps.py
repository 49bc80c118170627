"""RL826: clock counts physics steps."""

import dataclasses
import math
from collections.abc import Iterator, Mapping

import numpy as np

from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.experiments.attributes import AttributeLog
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.step_times import StepTimes, require_step_times, words_of
from rlctl.checking.timed_expressions import Use, find_wrong_time
from rlctl.checking.transitions import find_float_leaves, find_unit_pairs
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL826",
    "clock counts physics steps",
    Severity.WARNING,
    meaning="""
        A clock that each step advances runs with the time of one step of the physics, or counts the steps of the
        physics as if each was a whole step: a line of the source adds the one time where the other is meant, or it
        shows in what is observed. It is the phase of a gait whose period is declared, a time in seconds, passed or
        left, a time feature of the observation, or the time limit. All of them are then wrong by the number of physics
        steps in a step. Times are those of the engine; in a robot without an engine they are what it declares, as `dt`
        and `substeps` or by a loop of its step, and what its positions and velocities confirm, or those on which most
        lines that add up times agree.
    """,
    fix="""
        Advance the clock once in each step, by the time between two actions: the physics step times frame_skip, which
        is self.dt of a MujocoEnv.
    """,
    shows_one=True,
)

EXACT = 1e-4  # relative
SAME_TURN = 1e-3  # the same, of angles of float32
LEAST_STEPS = 20
LEAST_SWING, SINE_ERROR = 0.05, 2e-6
SLOWEST = math.cos(0.01)  # what turns less in a step [rad] cannot be told from a line
WRAPS = 0.3  # part of the steps in which a phase may begin again
STOPS = 0.4  # part of the steps in which a clock may stand at its end
PERIOD_WORDS = {"period", "cycle", "gait"}
FREQUENCY_WORDS = {"freq", "frequency", "hz", "cadence"}
TIME_WORDS = {"t", "time", "clock", "seconds", "elapsed", "remaining", "timer"}
TIMER_WORDS = TIME_WORDS | {
    "air",
    "stance",
    "swing",
    "contact",
    "cooldown",
    "wait",
    "dwell",
    "hold",
    "held",
    "still",
    "stuck",
}
FEWEST_ADVANCES = 8  # of a timer that often begins again
LIMIT_WORDS = {"max", "limit", "episode", "horizon", "length", "duration"}
SECOND_WORDS = {"s", "sec", "secs", "seconds", "time", "duration"}
STEP_WORDS = {"steps"}
PHYSICS_WORDS = {"physics", "sim", "substeps", "frames", "inner"}
FULL_TURN = 2 * math.pi


@dataclasses.dataclass(frozen=True)
class _Clock:
    """What advances by the same in each step."""

    name: str
    advance: float  # in a step; below 0 where it shows what is left
    is_angle: bool  # of a cosine and a sine
    is_observed: bool
    is_timer: bool = False  # it begins again within an episode, and may stand

    @property
    def verb(self) -> str:
        """What it does in each step."""
        return "advances" if self.advance > 0 else "falls"


@judges_records(RULE, *RECORDING, "attributes", "expressions")
def _judge(records: Records) -> Iterator[RuleFinding]:
    for timed, times in find_wrong_time(records, Use.COUNTED):
        message = f"{timed.target} advances by {timed.total_s:.4g} s in a step that takes {times.control_s:.4g} s"
        message += f", with {timed.text}"
        wrong = _name_wrong(timed.total_s, times)
        evidence = {"element": timed.target, "value": timed.total_s, "expected": times.control_s}
        yield RuleFinding(RULE, f"{message}: {wrong}", evidence, where=timed.where)
        return
    yield from _find_wrong_clocks(records)


def _find_wrong_clocks(records: Records) -> Iterator[RuleFinding]:
    log: AttributeLog = records.require_fact("attributes")
    times = require_step_times(log)
    limit = _find_limit(records)
    most_steps = limit or _find_declared_limit(records, log)
    found = [
        finding
        for clock in _find_clocks(records, log)
        for finding in _judge_clock(clock, log.declared, times, most_steps)
    ]
    if limit is not None and records.require_built().max_steps != limit:
        found += _judge_limit(limit, log.declared, times)
    yield from found[:1]  # what follows from the same clock is wrong too


def _find_limit(records: Records) -> int | None:
    """Return after how many steps episodes are cut off; None where that is not always the same."""
    lengths = {episode.steps for episode in records.alone if episode.ended == "truncated"}
    return lengths.pop() if len(lengths) == 1 else None


def _find_declared_limit(records: Records, log: AttributeLog) -> int | None:
    """Return the time limit that an environment declares, where no episode has come to it."""
    if limit := records.require_built().max_steps:
        return limit
    limits = {value for name, value in log.declared.items() if {*words_of(name)} & LIMIT_WORDS and _is_in_steps(name)}
    return int(limits.pop()) if len(limits) == 1 else None


def _is_in_steps(name: str) -> bool:
    words = set(words_of(name))
    return bool(words & STEP_WORDS and not words & PHYSICS_WORDS)


def _find_clocks(records: Records, log: AttributeLog) -> Iterator[_Clock]:
    built = records.require_built()
    leaves = find_float_leaves(built.leaves)
    names = [built.element(leaf, i) for leaf in leaves for i in range(int(np.prod(built.leaves[leaf].shape)))]
    if log.is_step.sum() < LEAST_STEPS:
        return
    for i, j in find_unit_pairs(log.observed):
        for one, two in ((i, j), (j, i)):
            angles = np.arctan2(log.observed[:, two], log.observed[:, one])
            turns = (log.changes(angles[:, None])[:, 0] + np.pi) % FULL_TURN - np.pi
            if np.ptp(turns) < EXACT and turns.mean() > 0:
                yield _Clock(f"the angle of ({names[one]}, {names[two]})", float(turns.mean()), True, True)
    for column, name in enumerate(names):
        if (turn := _find_sine(log, log.observed[:, column])) is not None:
            yield _Clock(name, turn, True, True)
    for rows, named, is_observed in ((log.values, log.names, False), (log.observed, names, True)):
        changes = log.changes(rows)
        for column, name in enumerate(named):
            if (advance := _find_advance(changes[:, column])) is not None:
                yield _Clock(name, advance, False, is_observed)
    for rows, named, is_observed in ((log.values, log.names, False), (log.observed, names, True)):
        changes, after = log.changes(rows), rows[log.is_step]
        for column, name in enumerate(named):
            advance = _find_timer(changes[:, column], after[:, column])
            if advance is not None and (is_observed or set(words_of(name)) & TIMER_WORDS):
                yield _Clock(name, advance, False, is_observed, is_timer=True)


def _find_advance(changes: Array) -> float | None:
    advance = float(np.median(changes))
    forwards = changes * np.sign(advance)
    is_usual = np.abs(changes - advance) <= EXACT * abs(advance)
    is_wrap = forwards < 0
    is_stop = (forwards >= 0) & (forwards < abs(advance))  # at its end, which it may reach within a step
    is_clock = advance != 0 and bool((is_usual | is_wrap | is_stop).all())
    return advance if is_clock and is_wrap.mean() < WRAPS and (~is_usual & is_stop).mean() < STOPS else None


def _find_timer(changes: Array, after: Array) -> float | None:
    """Return the advance of what counts the time of something that comes and goes, in the air say: it rises by always
    the same from 0, or falls by it to 0."""
    for sign in (1.0, -1.0):
        forwards = sign * changes
        is_last = (after == 0) if sign < 0 else np.zeros(len(after), bool)
        steps = forwards[(forwards > 0) & ~is_last]
        if len(steps) < FEWEST_ADVANCES:
            continue
        advance = float(np.median(steps))
        begins = forwards < 0
        is_start = np.isclose(after, 0.0) | np.isclose(after, advance) if sign > 0 else after > 0
        is_short = bool((np.abs(steps - advance) <= EXACT * advance).all() and (after >= 0).all())
        if is_short and begins.any() and is_start[begins].all():
            return sign * advance
    return None


def _find_sine(log: AttributeLog, values: Array) -> float | None:
    """Return by which angle a sine turns in each step; None for what is none: each value and the next but one add up to
    the one between them times twice the cosine of that angle."""
    looks = np.flatnonzero(log.is_step[1:] & log.is_step[:-1]) + 1
    middle, outer = values[looks - 1], values[looks] + values[looks - 2]
    if values.std() < LEAST_SWING or np.abs(values).max() > 1 + EXACT or len(looks) < LEAST_STEPS:
        return None
    factor = float(middle @ outer / (middle @ middle))
    is_sine = np.abs(outer - factor * middle).max() < SINE_ERROR and abs(factor) < 2 * SLOWEST
    return math.acos(factor / 2) if is_sine else None


def _judge_clock(
    clock: _Clock, declared: Mapping[str, float], times: StepTimes, limit: int | None
) -> Iterator[RuleFinding]:
    advance = abs(clock.advance)
    if clock.is_timer:
        if wrong := _name_wrong(advance, times):
            message = f"{clock.name} {clock.verb} by {advance:.4g} in a step that takes {times.control_s:.4g} s"
            yield _finding(clock.name, f"{message}: {wrong}", advance, times.control_s)
        return
    for name, period in _list_periods(declared):
        for whole in (FULL_TURN,) if clock.is_angle else (1.0, FULL_TURN):
            if _is_turn(clock.advance, times.control_s / period, whole):
                break
            for seconds in (times.physics_s, times.control_s * times.substeps):
                if _is_turn(clock.advance, seconds / period, whole):
                    shown_s = period * times.control_s / seconds
                    message = f"{clock.name} takes {shown_s:.4g} s for a whole turn, and {name} says {period:.4g} s"
                    yield _finding(clock.name, f"{message}: {_name_wrong(seconds, times)}", shown_s, period)
                    return
    is_part = limit is not None and math.isclose(advance * limit, 1.0, rel_tol=2 / limit)
    if clock.is_angle or is_part:
        return
    is_time = set(words_of(clock.name)) & TIME_WORDS or clock.is_observed
    if is_time and advance != round(advance) and (wrong := _name_wrong(advance, times)):
        message = f"{clock.name} {clock.verb} by {advance:.4g} in a step that takes {times.control_s:.4g} s"
        yield _finding(clock.name, f"{message}: {wrong}", advance, times.control_s)
        return
    if limit is None or not clock.is_observed or advance == round(advance):
        return
    end = advance * limit
    for factor in (times.substeps, 1 / times.substeps):
        if math.isclose(end, factor, rel_tol=2 / limit):
            message = f"{clock.name} {clock.verb} by {end:.3g} of 1 in an episode of {limit} steps"
            yield _finding(clock.name, f"{message}, and each has {times.substeps} steps of the physics", end, 1.0)
            return


def _is_turn(advance: float, turns: float, whole: float) -> bool:
    """Say whether a phase advances by a part of a turn; of a sine the direction is not known, nor how many whole turns
    lie between."""
    turn = turns % 1.0 * whole
    return any(math.isclose(advance, one, rel_tol=SAME_TURN) for one in (turn, whole - turn))


def _list_periods(declared: Mapping[str, float]) -> Iterator[tuple[str, float]]:
    for name, value in declared.items():
        words = set(words_of(name))
        if value > 0 and words & FREQUENCY_WORDS:  # first: gait_hz is no period
            yield name, 1 / value
        elif value > 0 and words & PERIOD_WORDS and not words & STEP_WORDS:
            yield name, value


def _name_wrong(seconds: float, times: StepTimes) -> str:
    """Say which wrong time it is; empty for any other."""
    if math.isclose(seconds, times.physics_s, rel_tol=EXACT):
        return f"it advances by one step of the physics, {times.physics_s:.4g} s, of the {times.substeps} in a step"
    if math.isclose(seconds, times.control_s * times.substeps, rel_tol=EXACT):
        return f"it advances by a whole step for each of the {times.substeps} steps of the physics"
    return ""


def _judge_limit(limit: int, declared: Mapping[str, float], times: StepTimes) -> Iterator[RuleFinding]:
    limits = {name: value for name, value in declared.items() if set(words_of(name)) & LIMIT_WORDS and value > 0}
    seconds = {n: v for n, v in limits.items() if set(words_of(n)) & SECOND_WORDS}
    steps = {name: value for name, value in limits.items() if _is_in_steps(name)}
    if limit in limits.values() or any(_ends_at(limit * times.control_s, v, times.control_s) for v in seconds.values()):
        return
    for name, value in seconds.items():
        for factor in (times.physics_s, times.control_s * times.substeps):
            if _ends_at(limit * factor, value, factor):
                message = (
                    f"episodes end after {limit} steps, {limit * times.control_s:.4g} s, and {name} is {value:.4g} s"
                )
                yield _finding(name, f"{message}: {_name_wrong(factor, times)}", limit * times.control_s, value)
                return
    for name, value in steps.items():
        if _ends_at(limit * times.substeps, value, times.substeps):
            message = f"episodes end after {limit} steps, and {name} is {value:.0f}"
            yield _finding(
                name, f"{message}: each step counts as its {times.substeps} steps of the physics", limit, value
            )
            return


def _ends_at(shown: float, limit: float, step: float) -> bool:
    """Say whether a limit was reached in the last step; one more may be taken."""
    return limit - 0.01 * step <= shown <= limit + 1.01 * step


def _finding(name: str, message: str, value: float, expected: float) -> RuleFinding:
    return RuleFinding(RULE, message, {"element": name, "value": value, "expected": expected})
