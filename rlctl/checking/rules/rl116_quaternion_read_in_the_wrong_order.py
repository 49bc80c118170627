"""RL116: quaternion read in the wrong order."""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import attitudes
from rlctl.checking.experiments.expressions import NotedEpisodes, judges_expressions
from rlctl.checking.experiments.worlds import ObservedWorld, WatchedWorlds, judges_worlds
from rlctl.checking.quaternion_orders import QuaternionOrders
from rlctl.checking.readings import NEARLY_ALL
from rlctl.checking.rule import Rule, RuleFinding, Severity, list_others
from rlctl.checking.world_logs import WorldLog
from rlctl.checking.worlds import ANGULAR, JOINTS, ORIENTATION, VELOCITY, Array, Link, World
from rlctl.environments.places import format_place

RULE = Rule(
    "RL116",
    "quaternion read in the wrong order",
    Severity.ERROR,
    meaning="""
        Elements of the observation are an angle, an axis or a velocity that was computed from a quaternion in
        the wrong order. PyBullet's and SciPy's order is x, y, z, w; that of MuJoCo is w, x, y, z. The observed
        orientation is wrong except near zero. Or the source unpacks a quaternion in the other order than it has where
        it comes from, gives it to a function that expects the other, or takes the wrong element for w.
    """,
    fix="""
        Convert once, where the quaternion is read. MuJoCo for SciPy - q[[1, 2, 3, 0]]; SciPy for MuJoCo -
        q[[3, 0, 1, 2]]; or scalar_first=True. PyBullet for a library with w first - (q[3], q[0], q[1], q[2]).
    """,
)

SAME = 5e-5  # An element is equal to a value if it differs by no more [rad], [m], [m/s], and relative to the value
MOVED, FEWEST_MOVED = 20, 15  # in so many looks a value is away from its median by so many times that, or it is calm
FIRST_LOOKS = 5  # Values that differ in these are not compared further
READ, CONVERTED, REVERSED = (1, 2, 3, 0), (3, 0, 1, 2), (2, 1, 0, 3)
"""Where x, y, z, w come from if (x, y, z, w) is read as w, x, y, z; if it is the other way round; and if the quaternion
with w first is turned round."""
ORDERS = {
    "PyBullet": {
        READ: "(x, y, z, w) read as w, x, y, z",
        CONVERTED: "converted to w, x, y, z and then read as x, y, z, w",
        REVERSED: "turned round: z, y, x, w",
    },
    "MuJoCo": {
        CONVERTED: "(w, x, y, z) read as x, y, z, w",
        READ: "converted to x, y, z, w and then read as w, x, y, z",
        REVERSED: "turned round: z, y, x, w",
    },
}
AXIS_NAMES = (*(f"the world's {axis} axis in the frame" for axis in "xyz"), *(f"the {axis} axis" for axis in "xyz"))
Match = tuple[int, Link, str, int, int]
"""Element, link, order, feature and sign."""


@judges_expressions(RULE, decides=False)
def _judge_source(noted: NotedEpisodes) -> Iterator[RuleFinding]:
    found = list(QuaternionOrders(noted).find_mistakes(RULE))
    for first in found[:1]:
        places = list(dict.fromkeys(format_place(*one.where) for one in found if one.where is not None))
        message = f"{first.message}{list_others(places)}"
        yield RuleFinding(RULE, message, {**first.evidence, "places": places}, where=first.where)


@judges_worlds(RULE)
def _judge_worlds(watched: WatchedWorlds) -> Iterator[RuleFinding]:
    found = False
    for one in watched.observed:
        for finding in _find_misread_quaternions(one):
            found = True
            yield finding
    # The yaw of an object that lies on something may be constant, where it is read in a wrong order.
    for one in watched.thrown if not found else ():
        yield from _find_misread_quaternions(one)


def _find_misread_quaternions(one: ObservedWorld) -> Iterator[RuleFinding]:
    """Yield an element of the observation that follows from a quaternion in a wrong order, and from no right one."""
    world, logs, observed = one.world.world, one.logs, one.observed
    moving = np.flatnonzero(_find_moved(observed).sum(axis=0) >= FEWEST_MOVED)
    looks = [poses for log in logs for poses in log.poses]
    links = sorted(set.intersection(*(set(poses) for poses in looks)))
    quaternions = {link: np.array([poses[link][ORIENTATION] for poses in looks]) for link in links}
    velocities = _find_velocities(logs)
    wrong: list[Match] = []
    orders = ORDERS[world.engine]
    for (link, values), (places, order) in itertools.product(quaternions.items(), orders.items()):
        names, features = _compute_all(values[:, places], velocities)
        features[:, _find_moved(features).sum(axis=0) < FEWEST_MOVED] = np.nan
        equal = _find_equal(observed[:, moving], features)
        wrong += [(int(moving[column]), link, order, feature, sign) for column, feature, sign in equal]
    if not wrong:
        return
    wrong = _drop_lonely_components(wrong)
    computed = [_compute_all(values, velocities)[1] for values in quaternions.values()]
    right = np.hstack([*computed, *velocities.values(), *_read_joints(logs)])
    equal = _find_equal(observed, right)
    signs = {(column, sign) for column, _, sign in equal}
    known = {column for column, _ in signs} | _find_turned(observed, {entry[0] for entry in wrong}, quaternions, logs)
    for column, link, order, feature, _ in sorted(wrong, key=lambda entry: entry[0]):
        if column not in known:
            yield _misread(world, one.name_element(column), names[feature], link, order)
            return
    matches = set(wrong)
    for column, link, order, feature, sign in sorted(wrong, key=lambda entry: entry[0]):
        is_right = any({(column, other), (column + 1, other)} <= signs for other in (1, -1))
        for other in () if is_right else next((angles for angles in attitudes.ANGLES if feature in angles), ()):
            if other != feature and (column + 1, link, order, other, sign) in matches:
                what = f"{names[feature]} and {names[other]}"
                yield _misread(world, one.name_elements(column, 2), what, link, order)
                return
    columns = sorted({column for column, *_ in wrong})
    rows = [column for column in range(observed.shape[1] - 2) if sum(column + i in columns for i in range(3)) >= 2]
    yield from _find_misread_axes(one, rows, quaternions)


def _drop_lonely_components(matches: Sequence[Match]) -> list[Match]:
    """Drop a component of a vector that is the only one of its vector: where a link turns about one axis, a wrong order
    turns any vector of the world by half a turn, so that one component is equal to itself up to its sign."""
    count = len(attitudes.NAMES)

    def vector_of(match: Match) -> tuple[Link, str, int]:
        _, link, order, feature, _ = match
        return link, order, attitudes.find_vector(feature - count)

    found: dict[tuple[Link, str, int], set[int]] = {}
    for match in matches:
        if match[3] >= count:
            found.setdefault(vector_of(match), set()).add(match[3])
    return [match for match in matches if match[3] < count or len(found[vector_of(match)]) > 1]


def _read_joints(logs: Sequence[WorldLog]) -> list[Array]:
    """Return the positions and speeds of the joints of each body. Shape (looks, 2 * joints) each."""
    bodies = range(len(logs[0].world.bodies))
    return [np.array([state[i][JOINTS:] for log in logs for state in log.states]) for i in bodies]


def _find_turned(
    observed: Array, columns: Collection[int], quaternions: Mapping[Link, Array], logs: Sequence[WorldLog]
) -> set[int]:
    """Return elements that are a right angle up to its sign and quarter turns (a gripper's that points down, say), the
    angle of a whole rotation, or a joint's position: where all turns about one axis, wrong orders give these too."""
    of_all = [attitudes.compute_attitudes(values)[:, : len(attitudes.ANGLES) * 3] for values in quaternions.values()]
    whole = [2 * np.arccos(np.clip(np.abs(values[:, 3:]), 0.0, 1.0)) for values in quaternions.values()]
    right = np.hstack([*of_all, *whole, *_read_joints(logs)])
    turned = set()
    for column in columns:
        values = observed[:, [column]]
        for off in (values - right, values + right):
            if ((np.abs(np.sin(2 * off)) <= 4 * SAME).mean(axis=0) >= NEARLY_ALL).any():
                turned.add(column)
    return turned


def _misread(world: World, element: str, what: str, link: Link, order: str) -> RuleFinding:
    right = "w, x, y, z" if world.engine == "MuJoCo" else "x, y, z, w"
    verb = "is" if element.endswith("]") and ":" not in element else "are"
    message = f"{element} {verb} {what} of {world.link_name(link)} with its quaternion {order}"
    return RuleFinding(RULE, message, {"element": element, "value": order, "expected": right})


def _find_misread_axes(
    one: ObservedWorld, columns: Sequence[int], quaternions: Mapping[Link, Array]
) -> Iterator[RuleFinding]:
    """Yield three elements that are an axis of a wrong rotation and of no right one: each element alone is, up to its
    sign, in the right matrix too."""
    world = one.world.world
    right = np.hstack([_find_axes(values) for values in quaternions.values()]) if columns else np.zeros(0)
    for column in columns:
        values = one.observed[:, None, column : column + 3]
        if _equal_axes(values, right).any():
            continue
        for (link, quaternion), (places, order) in itertools.product(quaternions.items(), ORDERS[world.engine].items()):
            is_same = _equal_axes(values, _find_axes(quaternion[:, places]))
            if is_same.any():
                what = AXIS_NAMES[int(is_same.argmax())]
                yield _misread(world, one.name_elements(column, 3), what, link, order)
                return


def _find_axes(quaternions: Array) -> Array:
    """Return the rows and the columns of the rotation matrices. Shape (n, 6, 3)."""
    matrices = attitudes.compute_matrices(quaternions)
    return np.concatenate([matrices, matrices.transpose(0, 2, 1)], axis=1)


def _equal_axes(values: Array, axes: Array) -> Array:
    near = [np.abs(values - sign * axes).max(axis=2) <= SAME for sign in (1.0, -1.0)]
    result: Array = np.logical_or(*(part.mean(axis=0) >= NEARLY_ALL for part in near))
    return result


def _find_velocities(logs: Sequence[WorldLog]) -> dict[str, Array]:
    """Return the velocities of each free base by their names. Shape (looks, 3) each."""
    velocities = {}
    for i, body in enumerate(logs[0].world.bodies):
        if body.is_free:
            states = np.array([state[i] for log in logs for state in log.states])
            velocities[f"the velocity of {body.name}"] = states[:, VELOCITY]
            velocities[f"the angular velocity of {body.name}"] = states[:, ANGULAR]
    return velocities


def _compute_all(quaternions: Array, velocities: Mapping[str, Array]) -> tuple[list[str], Array]:
    names, columns = list(attitudes.NAMES), [attitudes.compute_attitudes(quaternions)]
    for name, vectors in velocities.items():
        names += [f"{text} {name}, by the orientation" for text in attitudes.OF_VECTOR]
        columns.append(attitudes.rotate(quaternions, vectors))
    return names, np.hstack(columns)


def _find_equal(observed: Array, features: Array) -> list[tuple[int, int, int]]:
    """Return (column, feature, sign) where an element equals a value, times the sign, in nearly all looks."""

    def count(rows: Sequence[int], columns: Array, values: Array) -> Array:
        a, b = columns[rows][:, :, None], values[rows][:, None, :]
        part: Array = (np.abs(a - b) <= SAME * (1 + np.abs(b))).mean(axis=0)
        return part

    few, every = np.linspace(1, len(observed) - 1, FIRST_LOOKS).astype(int).tolist(), range(len(observed))
    found, moves = [], _find_moved(features)
    for sign in (1, -1):
        candidates = np.argwhere(count(few, observed, sign * features) >= 1 - 1.01 / FIRST_LOOKS).tolist()
        for c, f in candidates:
            looks = [every, np.flatnonzero(moves[:, f]).tolist()]
            if all(count(rows, observed[:, [c]], sign * features[:, [f]]) >= NEARLY_ALL for rows in looks if rows):
                found.append((c, f, sign))
    return found


def _find_moved(values: Array) -> NDArray[np.bool_]:
    """Say in which looks a value is away from its median by much more than the tolerance. Shape of `values`."""
    moved: NDArray[np.bool_] = np.abs(values - np.median(values, axis=0)) > MOVED * SAME
    return moved
