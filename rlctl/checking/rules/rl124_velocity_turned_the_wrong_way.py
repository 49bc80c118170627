"""RL124: velocity turned the wrong way."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import attitudes, wrong_turns
from rlctl.checking.body_frames import BodyFrame, find_body_frames
from rlctl.checking.engine_values import NOISY, is_white
from rlctl.checking.experiment import judges_records
from rlctl.checking.experiments.attributes import AttributeLog, find_log_without_engine
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.turned import TurnedRobot, judges_turned
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.fixed_directions import find_turned_directions, list_body_turns
from rlctl.checking.heading_waves import observe_headings
from rlctl.checking.readings import NEARLY_ALL
from rlctl.checking.records import FIRST_SEED, Fact, Records
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_names
from rlctl.checking.shared_frames import Turn, list_world_turns
from rlctl.checking.transitions import name_floats
from rlctl.checking.values import ArrayNames, name_numbers
from rlctl.checking.worlds import ANGULAR, ORIENTATION, VELOCITY, Array

RULE = Rule(
    "RL124",
    "velocity turned the wrong way",
    Severity.WARNING,
    meaning="""
        Three elements of the observation are the velocity of a free body, turned by its orientation in the wrong
        direction or twice: they are neither in the world's frame nor in that of the body. In PyBullet both velocities
        of a base are in the world's frame. In MuJoCo the velocity of a free joint is, qvel[0:3], and its angular
        velocity, qvel[3:6], is in the frame of the body already. So it is with gravity; and with a direction that
        reset draws, to the sun say, which moves then as what is fixed to the body does. A robot without an engine is
        read from its attributes: its velocity is what changes its position, its frame the one in which its actions
        push it, or the orientation that its angular velocity turns. A robot on level ground is also turned by the
        check: a velocity that follows twice its heading is turned the wrong way. Or a line of the source does so: it
        turns a vector of the world by an orientation itself, or multiplies an axis of the body, turned by the inverse,
        with a way in the world; or it turns one vector of the world by an angle in the other direction than another
        one; or a turn in the plane that is written by elements has one wrong sign, and turns nothing.
    """,
    fix="""
        From the world to the body it is the inverse rotation: R.T @ v, or rotation.inv().apply(v). MuJoCo's qvel[3:6]
        needs none.
    """,
)

CONFIRMED = 2  # starts that have to show it
DOUBLE = "velocities that follow twice the heading"
SAME = 5e-5  # of an element, relative to its value or to 1: see RL116
LEAST_MOTION = 1e-3  # root mean square [m/s], [rad/s]
LEAST_FACTOR = 1e-3  # by which a velocity may be scaled


@dataclasses.dataclass(frozen=True)
class _Vectors:
    """A velocity in all looks, as it may be observed. Shape (looks, 3) each."""

    name: str
    right: Sequence[Array]
    wrong: Sequence[Array]
    is_down: bool = False
    """Whether it is gravity: the opposite is an axis of the body, in the world."""


@judges_worlds(RULE)
def _find_wrong_turns(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in watched.observed:
        found = [
            finding
            for vectors in [*_list_velocities(one), *_list_gravities(one)]
            for finding in _find_in_observation(one.logs[0].parts, one.observed, vectors)
        ]
        yield from found or _find_directions(one.logs[0].parts, one.observed, one.episodes, list_world_turns(one))


@judges_turned(RULE, decides=False)
def _note_double_turns(robot: TurnedRobot) -> Iterator[Fact]:
    """Note the names of velocities of a moving robot that follow twice its heading."""
    found = list[set[int]]()
    for number in range(CONFIRMED):
        waves = observe_headings(robot, number)
        columns = set() if waves is None else waves.list_velocities(times=2)
        if not columns:
            return
        found.append(columns)
    names = name_floats(robot.instance.leaves)
    yield Fact(DOUBLE, [names[column] for column in sorted(set.intersection(*found))])


@judges_records(RULE, "worlds", "attributes", "turned")
def _find_wrong_turns_of_attributes(records: Records) -> Iterator[RuleFinding]:
    if names := records.facts.get(DOUBLE):
        what = "are velocities that turn" if len(names) > 1 else "is a velocity that turns"
        message = f"{list_names(names)} {what} by twice the heading of the robot as it moves forwards: the heading"
        message += " turns it in the wrong direction, and it is in no frame of the robot"
        yield RuleFinding(RULE, message, {"element": names[0], "seed": FIRST_SEED})
    log = find_log_without_engine(records)
    if log is not None:
        yield from find_wrong_turns(log)


@judges_expressions(RULE, decides=False)
def _find_wrong_turns_of_lines(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    mixed = wrong_turns.find_mixed_frames(RULE, noted.turned)
    broken = wrong_turns.find_broken_turns(RULE, noted.turned, of_ways=False)
    found = itertools.chain(mixed, wrong_turns.find_wrong_turns(RULE, noted.turned, of_ways=False), broken)
    yield from itertools.islice(found, 1)


def find_wrong_turns(log: AttributeLog) -> Iterator[RuleFinding]:
    """Yield the first velocity, or gravity, that a robot without an engine observes turned the wrong way."""
    for frame in find_body_frames(log):
        for vectors in _list_vectors(frame):
            for finding in _find_in_observation(log.parts, log.observed, vectors):
                yield finding
                return
    yield from _find_directions(log.parts, log.observed, log.episodes, list_body_turns(log))


def _find_directions(
    parts: ArrayNames, observed: Array, episodes: NDArray[np.int_], turns: Sequence[Turn]
) -> Iterator[RuleFinding]:
    """Yield the first direction that is fixed in the world, turned the wrong way."""
    for column, turn in find_turned_directions(observed, episodes, turns):
        name = name_numbers(parts, column, 3)
        message = f"{name} is a direction that reset draws, turned by {turn.name} the wrong way: it moves as what is"
        yield RuleFinding(RULE, f"{message} fixed to the body, not to the world", {"element": name, "value": turn.name})
        return


def _list_vectors(frame: BodyFrame) -> Iterator[_Vectors]:
    """Yield velocity and gravity of a robot without an engine."""
    down = np.zeros_like(frame.velocity)
    down[:, -1] = -1.0
    for name, vectors, is_down in ((frame.velocity_name, frame.velocity, False), ("gravity", down, True)):
        inside = np.einsum("nji,nj->ni", frame.matrices, vectors)
        outside = np.einsum("nij,nj->ni", frame.matrices, vectors)
        if frame.falls or not is_down:
            yield _Vectors(name, [vectors, inside], [outside], is_down)


def _list_gravities(one: ObservedWorld) -> Iterator[_Vectors]:
    """Yield the direction of gravity for each free body."""
    for body in one.logs[0].world.bodies:
        if body.is_free:
            quaternions = np.array([poses[body.id, -1][ORIENTATION] for log in one.logs for poses in log.poses])
            down = np.tile([0.0, 0.0, -1.0], (len(quaternions), 1))
            turned = attitudes.rotate(quaternions, down)
            yield _Vectors(f"gravity, as {body.name} feels it", [down, turned[:, :3]], [turned[:, 3:6]], True)


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
        return _Vectors(name, [values, outside], [inside])
    level = np.column_stack([turned[:, 6:], values[:, 2]])
    twice = attitudes.rotate(quaternions, inside)[:, :3]
    return _Vectors(name, [values, inside, level], [outside, twice])


def _find_in_observation(parts: ArrayNames, observed: Array, vectors: _Vectors) -> Iterator[RuleFinding]:
    size = vectors.wrong[0].shape[1]
    for column in range(observed.shape[1] - size + 1):
        block = observed[:, column : column + size]
        is_wrong = any(_fits(block, vectors, wrong) for wrong in vectors.wrong)
        if not is_wrong or any(_fits(block, vectors, right) for right in vectors.right):
            continue
        name = name_numbers(parts, column, size)
        message = f"{name} is {vectors.name}, turned by the orientation the wrong way: in no frame of the robot"
        yield RuleFinding(RULE, message, {"element": name, "value": vectors.name})
        return


def _fits(block: Array, vectors: _Vectors, values: Array) -> bool:
    """Say whether elements are vectors times a factor, exactly or with noise."""
    factor = float((block * values).sum() / max(1e-12, np.square(values).sum()))
    rest = block - factor * values
    near = np.abs(rest) <= SAME * (1 + np.abs(block))
    is_factor = factor > LEAST_FACTOR or (factor < -LEAST_FACTOR and not vectors.is_down)
    is_exact = bool(near.all(axis=1).mean() >= NEARLY_ALL)
    return is_factor and (is_exact or _is_noise(block, rest))


def _is_noise(block: Array, rest: Array) -> bool:
    moving = block - block.mean(axis=0)
    size = float(np.square(moving).sum())
    return size > 0 and float(np.square(rest).sum()) < NOISY * size and is_white(rest.T.ravel())
