"""RL820: velocity over the wrong time."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking.experiments.worlds import WatchedWorlds, judges_worlds
from rlctl.checking.joint_copies import LEAST_MOTION
from rlctl.checking.readings import MOST_ELEMENTS, name_features, read_features
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.world_logs import WorldLog
from rlctl.checking.worlds import Array

RULE = Rule(
    "RL820",
    "velocity over the wrong time",
    Severity.WARNING,
    meaning="""
        An element of the observation is how far something moved in a whole step of the environment, divided by
        the time of one step of the physics; or several are, turned into some frame. The velocity is too large by
        the number of physics steps, and a controller of the real robot that measures it right gives the policy
        something else.
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
PLACE = slice(0, 3)  # in a pose
FIRST_STEPS = 8  # Values that differ in these are not compared further


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        yield from _find_wrong_time(one.world.time_step, one.logs)


def _find_wrong_time(time_step: float, logs: Sequence[WorldLog]) -> Iterator[RuleFinding]:
    """Yield an element that is how far something moved in a control step, divided by the time of a physics step; or
    several, whose length is that of such a velocity, in whatever frame."""
    changes = _read_changes(logs, time_step)
    if changes is None:
        return
    names = name_features(logs[0]) + [f"observation[{column}]" for column in range(changes.observed.shape[1])]
    wrong = {}
    for column, values in enumerate(changes.observed.T):
        feature = _find_equal(values, changes.speeds) if values.std() > LEAST_MOTION else None
        if feature is not None:
            wrong[f"observation[{column}]"] = names[feature]
    wrong = wrong or _find_lengths(changes)
    if wrong:
        element, name = next(iter(wrong.items()))
        others = list(wrong)[1:]
        more = f" (likewise {list_names(others, 4)})" if others else ""
        what = f"{element} is the change of {name} in a step, divided by {time_step:.4g} s{more}"
        substeps = changes.substeps
        taken = f"the step takes {time_step * substeps:.4g} s, {substeps} steps of the physics"
        evidence = {"element": element, "value": time_step, "expected": time_step * substeps}
        yield RuleFinding(RULE, f"{what}; {taken}: it is {substeps} times too large", evidence)


@dataclasses.dataclass(frozen=True)
class _Changes:
    """What changes in each step of all logs, divided by the time of a physics step."""

    speeds: Array  # of features of the state, and of the observation. Shape (n, features + elements)
    velocities: Array  # of the places of bodies and links. Shape (n, places, 3)
    places: Sequence[str]  # their names
    observed: Array  # after each step. Shape (n, elements)
    substeps: int  # physics steps of a step


def _find_lengths(changes: _Changes) -> dict[str, str]:
    """Return two or three elements whose length is that of a velocity; and of what the velocity is."""
    for size in (3, 2):
        features = np.linalg.norm(changes.velocities[:, :, :size], axis=2)
        for column in range(changes.observed.shape[1] - size + 1):
            values = np.linalg.norm(changes.observed[:, column : column + size], axis=1)
            feature = _find_equal(values, features) if values.std() > LEAST_MOTION else None
            if feature is not None:
                return {f"observation[{column}:{column + size}]": f"the place of {changes.places[feature]}, turned,"}
    return {}


def _read_changes(logs: Sequence[WorldLog], time_step: float) -> _Changes | None:
    """Return the changes in each step; None where they are few, or a step has only one of the physics."""
    speeds, velocities, observed, times = [], [], [], []
    links = sorted(set.intersection(*(set(poses) for log in logs for poses in log.poses)))
    for log in logs:
        seen = np.nan_to_num(np.stack(log.observed).astype(np.float64))[:, :MOST_ELEMENTS]
        states = [read_features(log, *look) for look in zip(log.states, log.poses, strict=True)]
        speeds.append(np.diff(np.hstack([np.stack(states), seen]), axis=0))
        places = [np.reshape([poses[link][PLACE] for link in links], (-1, 3)) for poses in log.poses]
        velocities.append(np.diff(np.nan_to_num(places), axis=0))
        observed.append(seen[1:])
        times.append(np.diff(log.times))
    if len({part.shape[1] for part in speeds}) > 1 or sum(map(len, speeds)) < FEWEST_STEPS:
        return None
    substeps = float(np.median(np.concatenate(times))) / time_step
    if not substeps > 1.5:
        return None
    parts = np.concatenate(speeds) / time_step, np.concatenate(velocities) / time_step
    names = [logs[0].world.link_name(link) for link in links]
    return _Changes(*parts, names, np.concatenate(observed), round(substeps))


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
