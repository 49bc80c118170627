"""RL820: velocity over the wrong time."""

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
        the time of one step of the physics. The velocity is too large by the number of physics steps, and a
        controller of the real robot that measures it right gives the policy something else.
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
FIRST_STEPS = 8  # Values that differ in these are not compared further


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        yield from _find_wrong_time(one.world.time_step, one.logs)


def _find_wrong_time(time_step: float, logs: Sequence[WorldLog]) -> Iterator[RuleFinding]:
    """Yield an element that is how far something moved in a control step, divided by the time of a physics step."""
    if (read := _read_changes(logs, time_step)) is None:
        return
    speeds, observed, substeps = read
    names = name_features(logs[0]) + [f"observation[{column}]" for column in range(observed.shape[1])]
    wrong = {}
    for column, values in enumerate(observed.T):
        if values.std() > LEAST_MOTION and (feature := _find_equal(values, speeds)) is not None:
            wrong[column] = names[feature]
    if wrong:
        column, name = next(iter(wrong.items()))
        others = [f"observation[{other}]" for other in list(wrong)[1:]]
        more = f" (likewise {list_names(others, 4)})" if others else ""
        what = f"observation[{column}] is the change of {name} in a step, divided by {time_step:.4g} s{more}"
        taken = f"the step takes {time_step * substeps:.4g} s, {substeps} steps of the physics"
        evidence = {"element": f"observation[{column}]", "value": time_step, "expected": time_step * substeps}
        yield RuleFinding(RULE, f"{what}; {taken}: it is {substeps} times too large", evidence)


def _read_changes(logs: Sequence[WorldLog], time_step: float) -> tuple[Array, Array, int] | None:
    """Return the changes of features of the state, and of the observation, in each step, divided by the time of a
    physics step; what was observed after the step; and how many physics steps it had. None if it had only one."""
    changes, observed, times = [], [], []
    for log in logs:
        seen = np.nan_to_num(np.stack(log.observed).astype(np.float64))[:, :MOST_ELEMENTS]
        states = [read_features(log, *look) for look in zip(log.states, log.poses, strict=True)]
        changes.append(np.diff(np.hstack([np.stack(states), seen]), axis=0))
        observed.append(seen[1:])
        times.append(np.diff(log.times))
    if len({part.shape[1] for part in changes}) > 1 or sum(map(len, changes)) < FEWEST_STEPS:
        return None
    substeps = float(np.median(np.concatenate(times))) / time_step
    if not substeps > 1.5:
        return None
    return np.concatenate(changes) / time_step, np.concatenate(observed), round(substeps)


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
