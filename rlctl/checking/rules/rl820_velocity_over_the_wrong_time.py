"""RL820: velocity over the wrong time."""

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.engine_values import NOISY, NOISY_FACTOR, EngineValues, explain, is_white
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import find_log_without_engine, find_weights
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.joint_copies import LEAST_MOTION
from rlctl.checking.readings import MOST_ELEMENTS, name_features, read_features
from rlctl.checking.records import Records
from rlctl.checking.rule import NotApplicable, Rule, RuleFinding, Severity, list_others
from rlctl.checking.step_times import StepTimes, require_step_times
from rlctl.checking.term_names import split_name
from rlctl.checking.timed_expressions import Use, find_wrong_time
from rlctl.checking.told_speeds import (
    ToldSpeed,
    find_told_speeds,
    read_attribute_ways,
    read_engine_ways,
    read_told,
)
from rlctl.checking.transitions import name_floats
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL820",
    "velocity over the wrong time",
    Severity.WARNING,
    meaning="""
        An element of the observation is how far something moved in a whole step of the environment, divided by the time
        of one step of the physics; or several are, turned into some frame; or a number of info is, such as the speed
        that is paid, or a term of the reward; or a line of the source divides so what changes in a whole step. The
        velocity is too large by the number of physics steps, and a controller of the real robot that measures it right
        gives the policy something else. So it is where the change is not divided by any time, and a name or other
        elements say that velocities are meant; otherwise that is an info. Objects that nobody moved are thrown to see
        it.
    """,
    fix="""
        Divide by the time between two actions, self.dt of a MujocoEnv, which is model.opt.timestep *
        frame_skip.
    """,
    shows_one=True,
)

NEARLY_ALL = 0.98  # of all steps: an observation may be cut off in some
CLOSE, MOVING = 1e-3, 0.1
"""Parts of a velocity's standard deviation: differences of float32 positions, and what is not small."""
FEWEST_STEPS = 30
TINY_WAY = 1e-5  # [m], [rad]; standard deviation of what moves in a step
SPEED_WORDS = {"vel", "velocity", "velocities", "speed", "speeds", "qvel", "dq", "twist", "rate", "rates"}
PLACE = slice(0, 3)  # in a pose
FIRST_STEPS = 8  # Values that differ in these are not compared further


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for number, one in enumerate([*watched.observed, *watched.thrown]):
        changes = _read_changes(one)
        found = list(_find_wrong_times(one, changes)) if changes is not None else []
        if not found and number < len(watched.observed):
            found = list(_find_told(one, changes, watched)) if changes is not None else []
        yield from found
        if found and number >= len(watched.observed) - 1:
            return  # what was thrown would show the same


def _find_told(one: ObservedWorld, changes: "_Changes", watched: WatchedWorlds) -> Iterator[RuleFinding]:
    """Yield a number of info, or the reward, that is a way in a step over the time of a step of the physics."""
    ways = read_engine_ways(one.logs)
    if changes.substeps <= 1 or ways is None:
        return
    names = {name for log in one.logs for told in log.told for name in told}
    rows = [pair for log in one.logs for pair in zip(log.told[1:], log.rewards[1:], strict=True)]
    infos = {name: np.array([told.get(name, np.nan) for told, _ in rows]) for name in names}
    told = read_told(infos, np.array([reward for _, reward in rows]))
    times = StepTimes(changes.seconds, changes.time_step, "the engine")
    actions = np.concatenate([np.stack(log.given[1:]) for log in one.logs if len(log.given) > 1])
    for speed in find_told_speeds(told, ways, times, find_weights(watched.instance.env), actions):
        yield _describe_told(speed, times)
        return


@judges_records(RULE, "worlds", "attributes", "expressions")
def _judge_records(records: Records) -> Iterator[RuleFinding]:
    for timed, times in find_wrong_time(records, Use.DIVIDED):
        message = f"{timed.text} divides the change of a whole step by {timed.seconds:.4g} s; the step takes"
        message += (
            f" {times.control_s:.4g} s, {times.substeps} steps of the physics: it is {times.substeps} times too large"
        )
        evidence = {"element": timed.target, "value": timed.seconds, "expected": times.control_s}
        yield RuleFinding(RULE, message, evidence, where=timed.where)
        return
    yield from _judge_attributes(records)


def _judge_attributes(records: Records) -> Iterator[RuleFinding]:
    """Yield what a robot without an engine tells."""
    log = find_log_without_engine(records)
    if log is None:
        return
    try:
        times = require_step_times(log)
    except NotApplicable:
        return
    told = {name: values[log.is_step] for name, values in read_told(log.infos, log.rewards).items()}
    told |= {
        name: log.observed[log.is_step, column]
        for column, name in enumerate(name_floats(records.require_built().leaves))
    }
    weights = [*log.literals, *map(abs, log.declared.values())]
    for speed in find_told_speeds(told, read_attribute_ways(log), times, weights, log.actions[log.is_step]):
        yield _describe_told(speed, times)
        return


def _describe_told(speed: ToldSpeed, times: StepTimes) -> RuleFinding:
    weight = "" if math.isclose(speed.weight, 1.0, rel_tol=CLOSE) else f"{speed.weight:.4g} times "
    what = f"{speed.name} is {weight}the change of {speed.way} in a step, divided by {times.physics_s:.4g} s"
    taken = f"the step takes {times.control_s:.4g} s, {times.substeps} steps of the physics"
    message = f"{what}; {taken}: it is {times.substeps} times too large"
    return RuleFinding(RULE, message, {"element": speed.name, "value": times.physics_s, "expected": times.control_s})


@dataclasses.dataclass(frozen=True)
class _Changes:
    """What changes in each step of all logs."""

    ways: Array  # of features of the state, and of the observation. Shape (n, features + elements)
    names: Sequence[str]  # of these
    places_end: int  # the first of these are places or angles of the engine
    places: Array  # of bodies and links. Shape (n, places, 3)
    place_names: Sequence[str]
    speeds: Array  # velocities that the engine has after each step. Shape (n, speeds)
    observed: Array  # after each step. Shape (n, elements)
    time_step: float  # of the physics [s]
    seconds: float  # of a step [s]

    @property
    def substeps(self) -> int:
        """Physics steps of a step."""
        return round(self.seconds / self.time_step)

    @functools.cached_property
    def wrong_times(self) -> list[float]:
        """The times by which changes may be divided by mistake [s]; 1 is none."""
        return [time for time in (self.time_step, 1.0) if not math.isclose(time, self.seconds, rel_tol=0.4)]

    def find_least(self, seconds: float) -> float:
        """Return the standard deviation of a change over a time below which it is too small to tell."""
        return LEAST_MOTION * min(1.0, self.seconds / seconds)

    @functools.cached_property
    def _are_moving(self) -> NDArray[np.bool_]:
        return np.asarray(self.ways[:, : self.places_end].std(axis=0) > TINY_WAY)

    @functools.cached_property
    def moving_ways(self) -> Array:
        """The changes of what moves, centered. Shape (n, k)."""
        ways = self.ways[:, : self.places_end][:, self._are_moving]
        return ways - ways.mean(axis=0)

    @functools.cached_property
    def moving_names(self) -> list[str]:
        """What these are changes of."""
        return [self.names[number] for number in np.flatnonzero(self._are_moving).tolist()]

    @functools.cached_property
    def moving_speeds(self) -> Array:
        """The velocities of what moves, centered. Shape (n, k)."""
        speeds = self.speeds[:, self.speeds.std(axis=0) > LEAST_MOTION]
        return speeds - speeds.mean(axis=0)


@dataclasses.dataclass(frozen=True)
class _WrongTime:
    """Elements of the observation that are a change in a step over the wrong time."""

    columns: slice
    what: str  # changes
    seconds: float  # by which it is divided [s]


def _find_wrong_times(one: ObservedWorld, changes: _Changes) -> Iterator[RuleFinding]:
    """Yield elements that are how far something moved in a step, divided by the time of a step of the physics, or not
    divided."""
    found = list(_match_elements(changes)) or list(_match_lengths(changes))
    physics = [wrong for wrong in found if wrong.seconds == changes.time_step]
    others = [wrong for wrong in found if wrong.seconds != changes.time_step]
    if physics:
        yield _describe_physics(one, physics, changes)
    if others:
        yield _describe_other(one, others, changes)


def _describe_physics(one: ObservedWorld, wrong: Sequence[_WrongTime], changes: _Changes) -> RuleFinding:
    names = [one.name_elements(each.columns.start, each.columns.stop - each.columns.start) for each in wrong]
    what = f"{names[0]} is the change of {wrong[0].what} in a step, divided by {changes.time_step:.4g} s"
    taken = f"the step takes {changes.seconds:.4g} s, {changes.substeps} steps of the physics"
    message = f"{what}{list_others(names)}; {taken}: it is {changes.substeps} times too large"
    evidence = {"element": names[0], "value": changes.time_step, "expected": changes.seconds}
    return RuleFinding(RULE, message, evidence)


def _describe_other(one: ObservedWorld, wrong: Sequence[_WrongTime], changes: _Changes) -> RuleFinding:
    """Describe a change that is not divided; an info where nothing says that it is meant as a velocity."""
    names = [one.name_elements(each.columns.start, each.columns.stop - each.columns.start) for each in wrong]
    what = f"{names[0]} is the change of {wrong[0].what} in a step{list_others(names)}"
    taken = f"not divided by the {changes.seconds:.4g} s that a step takes"
    speed = next((scaled for scaled in one.scaled if scaled.value.is_speed and scaled.has_factor(1.0)), None)
    called = next((name for name in names if set(split_name(name)) & SPEED_WORDS), None)
    severity = Severity.WARNING
    if called is not None:
        why = f"{called} is called a velocity"
    elif speed is not None:
        why = f"{one.name_element(speed.column)}, the {speed.value.name}, is a velocity per second"
    else:
        why, severity = "if it is meant as a velocity, it depends on the length of the step", Severity.INFO
    evidence = {"element": names[0], "value": wrong[0].seconds, "expected": changes.seconds}
    return RuleFinding(RULE, f"{what}, {taken}; {why}", evidence, severity)


def _match_elements(changes: _Changes) -> Iterator[_WrongTime]:
    """Yield the elements that are a change, exactly or with noise."""
    for column, values in enumerate(changes.observed.T):
        wrong = _match_exact(changes, column, values) or _match_noisy(changes, column, values)
        if wrong is not None:
            yield wrong


def _match_exact(changes: _Changes, column: int, values: Array) -> _WrongTime | None:
    for seconds in changes.wrong_times:
        ways = changes.ways if seconds == changes.time_step else changes.ways[:, : changes.places_end]
        if values.std() > changes.find_least(seconds):
            feature = _find_equal(values * seconds, ways)
            if feature is not None:
                return _WrongTime(slice(column, column + 1), changes.names[feature], seconds)
    return None


def _match_noisy(changes: _Changes, column: int, values: Array) -> _WrongTime | None:
    """Return the change, over the time of a step of the physics, that an element with noise is; the velocity that the
    engine has at the end of the step must explain it less well, or it is that velocity times a factor."""
    seconds = changes.time_step
    if seconds not in changes.wrong_times or values.std() <= LEAST_MOTION:
        return None
    ways, centered = changes.moving_ways, (values - values.mean())[:, None]
    if not ways.size:
        return None
    factors, left = explain(centered, ways)
    best = int(left[:, 0].argmin())
    factor, rest = float(factors[best, 0]), float(left[best, 0])
    if rest > NOISY or not math.isclose(abs(factor) * seconds, 1.0, rel_tol=NOISY_FACTOR):
        return None
    is_noise = is_white(centered[:, 0] - factor * ways[:, best])
    speeds = changes.moving_speeds
    of_engine = float(explain(centered, speeds)[1].min()) if speeds.size else 1.0
    if not is_noise or rest >= of_engine:
        return None
    return _WrongTime(slice(column, column + 1), changes.moving_names[best], seconds)


def _match_lengths(changes: _Changes) -> Iterator[_WrongTime]:
    """Yield two or three elements whose length is that of a velocity over the wrong time, in whatever frame."""
    for size in (3, 2):
        ways = np.linalg.norm(changes.places[:, :, :size], axis=2)
        for column in range(changes.observed.shape[1] - size + 1):
            values = np.linalg.norm(changes.observed[:, column : column + size], axis=1)
            for seconds in changes.wrong_times:
                is_moving = values.std() > changes.find_least(seconds)
                place = _find_equal(values * seconds, ways) if is_moving else None
                if place is not None:
                    name = f"the place of {changes.place_names[place]}, turned,"
                    yield _WrongTime(slice(column, column + size), name, seconds)
                    return


def _read_changes(one: ObservedWorld) -> _Changes | None:
    """Return the changes in each step; None where they are few."""
    logs, time_step = one.logs, one.world.time_step
    ways, places, speeds, observed, times = [], [], [], [], []
    links = sorted(set.intersection(*(set(poses) for log in logs for poses in log.poses)))
    values = EngineValues.read(logs)
    sizes = [len(log.states) for log in logs]
    engine = np.split(values.rows, np.cumsum(sizes)[:-1])
    are_speeds = np.array([value.is_speed for value in values.names], np.bool_)
    for log, rows in zip(logs, engine, strict=True):
        seen = np.nan_to_num(np.stack(log.observed).astype(np.float64))[:, :MOST_ELEMENTS]
        states = [read_features(log, *look) for look in zip(log.states, log.poses, strict=True)]
        ways.append(np.diff(np.hstack([rows[:, ~are_speeds], np.stack(states), seen]), axis=0))
        positions = [np.reshape([poses[link][PLACE] for link in links], (-1, 3)) for poses in log.poses]
        places.append(np.diff(np.nan_to_num(positions), axis=0))
        speeds.append(rows[1:, are_speeds])
        observed.append(seen[1:])
        times.append(np.diff(log.times))
    if len({part.shape[1] for part in ways}) > 1 or sum(map(len, ways)) < FEWEST_STEPS:
        return None
    names = [value.name for value in values.names if not value.is_speed]
    count = len(names)
    names += name_features(logs[0])
    names += [one.name_element(column) for column in range(observed[0].shape[1])]
    return _Changes(
        ways=np.concatenate(ways),
        names=names,
        places_end=count,
        places=np.concatenate(places),
        place_names=[logs[0].world.link_name(link) for link in links],
        speeds=np.concatenate(speeds),
        observed=np.concatenate(observed),
        time_step=time_step,
        seconds=float(np.median(np.concatenate(times))),
    )


def _find_equal(values: Array, features: Array) -> int | None:
    """Return the feature that values equal, up to its sign, in nearly all steps, also where they are not small."""
    allowed = CLOSE * values.std()
    moving = np.flatnonzero(np.abs(values) > MOVING * values.std())
    if len(moving) < FEWEST_STEPS // 2:
        return None
    few = moving[:: max(1, len(moving) // FIRST_STEPS)]
    for sign in (1.0, -1.0):
        part = (np.abs(values[few, None] - sign * features[few]) <= allowed).mean(axis=0)
        for feature in np.flatnonzero(part >= 1 - 1.5 / len(few)).tolist():
            near = np.abs(values - sign * features[:, feature]) <= allowed
            if min(near.mean(), near[moving].mean()) >= NEARLY_ALL:
                return int(feature)
    return None
