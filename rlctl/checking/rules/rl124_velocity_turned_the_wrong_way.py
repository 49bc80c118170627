"""RL124: velocity turned the wrong way."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.readings import NEARLY_ALL
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.worlds import ANGULAR, ORIENTATION, VELOCITY, Array

RULE = Rule(
    "RL124",
    "velocity turned the wrong way",
    Severity.WARNING,
    meaning="""
        Three elements of the observation are the velocity of a free body, turned by its orientation in the wrong
        direction or twice: they are neither in the world's frame nor in that of the body. In PyBullet both
        velocities of a base are in the world's frame. In MuJoCo the velocity of a free joint is, qvel[0:3], and its
        angular velocity, qvel[3:6], is in the frame of the body already.
    """,
    fix="""
        From the world to the body it is the inverse rotation: R.T @ v, or rotation.inv().apply(v). MuJoCo's qvel[3:6]
        needs none.
    """,
)

SAME = 5e-5  # of an element, relative to its value or to 1: see RL116
LEAST_MOTION = 1e-3  # root mean square [m/s], [rad/s]
LEAST_FACTOR = 1e-3  # by which a velocity may be scaled


@dataclasses.dataclass(frozen=True)
class _Vectors:
    """A velocity in all looks, as it may be observed. Shape (looks, 3) each."""

    name: str
    right: Sequence[Array]
    wrong: Array


@judges_worlds(RULE)
def _find_wrong_turns(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        for vectors in _list_velocities(one):
            yield from _find_in_observation(one, vectors)


def _list_velocities(one: ObservedWorld) -> Iterator[_Vectors]:
    """Yield both velocities of each free body, where they are large enough."""
    is_local = one.world.world.engine == "MuJoCo"
    for number, body in enumerate(one.logs[0].world.bodies):
        if not body.is_free:
            continue
        states = np.array([state[number] for log in one.logs for state in log.states])
        quaternions = np.array([poses[body.id, -1][ORIENTATION] for log in one.logs for poses in log.poses])
        for what, columns, is_own in (("velocity", VELOCITY, False), ("angular velocity", ANGULAR, is_local)):
            values = np.nan_to_num(states[:, columns])
            if np.sqrt(np.mean(np.square(values))) >= LEAST_MOTION:
                yield _turn(f"the {what} of {body.name}", values, quaternions, is_own=is_own)


def _turn(name: str, values: Array, quaternions: Array, *, is_own: bool) -> _Vectors:
    """Turn vectors; `is_own` says that they are in the body's frame, and not in the world's."""
    turned = attitudes.rotate(quaternions, values)
    inside, outside = turned[:, :3], turned[:, 3:6]
    if is_own:
        return _Vectors(name, [values, outside], inside)
    level = np.column_stack([turned[:, 6:], values[:, 2]])
    return _Vectors(name, [values, inside, level], outside)


def _find_in_observation(one: ObservedWorld, vectors: _Vectors) -> Iterator[RuleFinding]:
    for column in range(one.observed.shape[1] - 2):
        block = one.observed[:, column : column + 3]
        if not _fits(block, vectors.wrong) or any(_fits(block, right) for right in vectors.right):
            continue
        name = f"observation[{column}:{column + 3}]"
        message = f"{name} is {vectors.name}, turned by the orientation the wrong way: in no frame of the robot"
        yield RuleFinding(RULE, message, {"element": name, "value": vectors.name})
        return


def _fits(block: Array, vectors: Array) -> bool:
    """Say whether three elements are vectors times a factor."""
    factor = float((block * vectors).sum() / max(1e-12, np.square(vectors).sum()))
    near = np.abs(block - factor * vectors) <= SAME * (1 + np.abs(block))
    return abs(factor) > LEAST_FACTOR and bool(near.all(axis=1).mean() >= NEARLY_ALL)
