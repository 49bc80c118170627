"""RL130: velocity transformed as a point."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.body_frames import turn_plane
from rlctl.checking.engine_values import NOISY, is_white
from rlctl.checking.experiment import RECORDING, judges_records
from rlctl.checking.experiments.attributes import find_log_without_engine
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.points_and_velocities import LoggedPlace, LoggedVelocity, list_places_of
from rlctl.checking.readings import NEARLY_ALL
from rlctl.checking.records import Records
from rlctl.checking.rule import Rule, RuleFinding, Severity
from rlctl.checking.shared_frames import list_attribute_turns, name_elements, name_observed, name_part
from rlctl.checking.transformed_velocities import TransformedVelocities
from rlctl.checking.worlds import CENTRE, FRAME, LINEAR, TURN, TURNING, Array

RULE = Rule(
    "RL130",
    "velocity transformed as a point",
    Severity.WARNING,
    meaning="""
        Two or three elements of the observation are a velocity from which a position was subtracted: v - p, or
        R.T @ (v - p) in the frame of a body. A function that transforms points was called with a velocity, or a
        line of the source subtracts one from the other. What stands still has a velocity then, and the further from the
        origin of the world, the larger.
    """,
    fix="A velocity is only rotated, R.T @ v; the origin of a frame is subtracted from points.",
)

SAME = 5e-5  # of an element, relative to its value or to 1
MOVING = 20 * SAME  # root mean square of a velocity and of a position, as they are observed
CLEARLY = 10.0  # how many times more is left without the position, or without the velocity
LEAST_FACTOR = 1e-3
MOST_POINTS = 12
MOST_ELEMENTS = 100


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    yield from itertools.islice(TransformedVelocities(noted).find(RULE), 1)


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    for one in [*watched.observed, *watched.thrown]:
        found = _find_point(one.observed, *_read_world(one), sizes=(3, 2))
        if found is not None:
            names, _ = name_observed(watched.instance.env, one)
            yield _describe(names, *found)
            return


@judges_records(RULE, *RECORDING, "worlds", "attributes")
def _judge_records(records: Records) -> Iterator[RuleFinding]:
    log = find_log_without_engine(records)
    if log is None:
        return
    matrices = [turn.matrices for turn in list_attribute_turns(log)]
    for size in (3, 2):
        found = _find_point(log.observed, *list_places_of(log, size, matrices), sizes=(size,))
        if found is not None:
            yield _describe(name_elements(records.require_built())[0], *found)
            return


def _read_world(one: ObservedWorld) -> tuple[list[LoggedPlace], list[LoggedVelocity]]:
    """Return the places of all links with their rotations, and their velocities."""
    points = np.array([rows for log in one.logs for rows in log.points])
    places, velocities = [], []
    names = one.logs[0].reader.name_points()
    for name, rows in list(zip(names, points.transpose(1, 0, 2), strict=True))[:MOST_POINTS]:
        matrices = attitudes.compute_matrices(rows[:, TURN])
        arms = rows[:, FRAME] - rows[:, CENTRE]
        at_frame = rows[:, LINEAR] + np.cross(rows[:, TURNING], arms)
        places.append(LoggedPlace(f"the position of {name}", rows[:, FRAME], matrices))
        velocities += [LoggedVelocity(f"the velocity of {name}", at_frame)]
        if np.abs(arms).max(initial=0.0) > SAME:
            places.append(LoggedPlace(f"the position of {name}", rows[:, CENTRE], matrices))
            velocities += [LoggedVelocity(f"the velocity of {name}", rows[:, LINEAR])]
        velocities += [LoggedVelocity(f"the angular velocity of {name}", rows[:, TURNING])]
    return places, [one for one in velocities if np.sqrt(np.square(one.vectors).mean()) > MOVING]


def _find_point(
    observed: Array, places: Sequence[LoggedPlace], velocities: Sequence[LoggedVelocity], sizes: Sequence[int]
) -> tuple[slice, LoggedVelocity, LoggedPlace] | None:
    for size in sizes:
        columns = range(min(MOST_ELEMENTS, observed.shape[1] - size + 1))
        if not columns or not velocities:
            continue
        blocks = np.array([observed[:, column : column + size].ravel() for column in columns])
        for place in places:
            for matrices in _list_rotations(place, size):
                point = _turn_in(place.points, matrices, size)
                for velocity in velocities:
                    moved = _turn_in(velocity.vectors, matrices, size)
                    for column in _fit(blocks, moved, point):
                        return slice(column, column + size), velocity, place
    return None


def _list_rotations(place: LoggedPlace, size: int) -> list[Array]:
    same = np.tile(np.eye(size), (len(place.points), 1, 1))
    if place.matrices is None:
        return [same]
    level = turn_plane(np.arctan2(place.matrices[:, 1, 0], place.matrices[:, 0, 0]))
    return [level if size == 2 else place.matrices, same]


def _turn_in(vectors: Array, matrices: Array, size: int) -> Array:
    """Return vectors in a frame, shape (looks, size)."""
    return np.asarray(np.einsum("nji,nj->ni", matrices, vectors[:, :size]))


def _fit(blocks: Array, velocity: Array, point: Array) -> Iterator[int]:
    """Yield which blocks are a velocity minus a point, times a factor. Shapes (blocks, looks * size), (looks, size)."""
    wrong = (velocity - point).ravel()
    factors = blocks @ wrong / max(float(wrong @ wrong), 1e-12)
    rests = np.square(blocks - factors[:, None] * wrong).sum(axis=1)
    alone = np.minimum(_measure_rests(blocks, velocity.ravel()), _measure_rests(blocks, point.ravel()))
    moved = np.square(factors) * float(np.square(velocity).sum())
    for column in np.flatnonzero((rests < NOISY * moved) & (CLEARLY * rests < alone) & (factors > LEAST_FACTOR)):
        factor, block = factors[column], blocks[column].reshape(velocity.shape)
        moves = [factor * np.sqrt(np.square(velocity).mean(axis=0)), factor * point.std(axis=0)]
        rest = block - factor * (velocity - point)
        is_exact = bool((np.abs(rest) <= SAME * (1 + np.abs(block))).all(axis=1).mean() >= NEARLY_ALL)
        if all((size > MOVING).sum() >= 2 for size in moves) and (is_exact or is_white(rest.T.ravel())):
            yield int(column)


def _measure_rests(blocks: Array, values: Array) -> Array:
    """Return what is left of blocks without what values explain. Shape (blocks,)."""
    size = max(float(values @ values), 1e-12)
    return np.asarray(np.square(blocks).sum(axis=1) - np.square(blocks @ values) / size)


def _describe(names: Sequence[str], part: slice, velocity: LoggedVelocity, place: LoggedPlace) -> RuleFinding:
    name = name_part(names[part])
    message = f"{name} are {velocity.name} minus {place.name}: they are not 0 where nothing moves"
    return RuleFinding(RULE, message, {"element": name, "value": velocity.name})
