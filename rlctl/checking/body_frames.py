"""Which attributes of a robot in NumPy are the frame of its body: the frame in which its actions push it."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.experiments.attributes import AttributeLog, Numbers
from rlctl.checking.step_times import find_rates

UNIT = 1e-4  # how far lengths of unit vectors may be from 1
LEAST_TURN = 0.15  # root mean square of a rotation minus its inverse: smaller ones have no wrong way
EXPLAINED, CLEARLY = 0.3, 3.0
"""Part of what moves the body that may be left; how many times more is left by every other frame."""
GRAVITY, SAME_GRAVITY = 9.81, 0.3  # [m/s^2]; relative
FEWEST_STEPS = 60


@dataclasses.dataclass(frozen=True, eq=False)
class BodyFrame:
    """The frame of a body that moves and turns, in the plane or in space."""

    name: str  # of the attribute that has its orientation
    velocity_name: str
    matrices: Numbers  # From the body's frame to the world's. Shape (looks, d, d)
    velocity: Numbers  # In the world. Shape (looks, d)
    falls: bool  # whether gravity acts along the last axis


def find_body_frames(log: AttributeLog) -> Iterator[BodyFrame]:
    """Yield the frames of what moves, where its actions tell which way it is turned."""
    if log.is_step.sum() < FEWEST_STEPS or not log.actions.any():
        return
    for columns, seconds in _find_velocities(log):
        velocity = log.values[:, columns]
        turns = list(_list_turns(log, len(columns)))
        rests = np.array([_measure_rests(log, velocity, m, GRAVITY * seconds) for _, m in turns]).reshape(
            len(turns), -1
        )
        chosen = {place for measure in rests.T if (place := _find_clear(measure, turns)) is not None}
        if len(chosen) == 1:
            name, matrices = turns[chosen.pop()]
            first = log.names[columns[0]]
            velocity_name = first if first[-2:] != "0]" else first.rpartition("[")[0]
            falls = _falls(log, velocity, matrices, GRAVITY * seconds)
            yield BodyFrame(name, velocity_name, matrices, velocity, falls)


def _find_clear(rests: Numbers, turns: Sequence[tuple[str, Numbers]]) -> int | None:
    """Return the orientation that explains clearly more than all others; None where none does, or it hardly turns."""
    best = int(rests.argmin())
    matrices = turns[best][1]
    others = [rest for rest, (_, m) in zip(rests, turns, strict=True) if np.abs(m - matrices).max() > LEAST_TURN]
    turn = matrices - matrices.transpose(0, 2, 1)
    is_turned = float(np.sqrt(np.mean(np.square(turn)))) >= LEAST_TURN
    is_clear = min(others, default=1.0) > CLEARLY * max(rests[best], 1e-9)
    return best if rests[best] < EXPLAINED and is_turned and is_clear else None


def _find_velocities(log: AttributeLog) -> Iterator[tuple[list[int], float]]:
    """Yield two or three consecutive numbers that are the velocity of others, and how long a step takes [s]."""
    rates = {place: (rate, seconds) for place, rate, seconds in find_rates(log, log.values)}
    for size in (3, 2):
        for place in rates:
            places = range(place, place + size)
            if not all(one in rates for one in places):
                continue
            columns = [rates[one][0] for one in places]
            is_block = columns == list(range(columns[0], columns[0] + size)) and columns[0] not in places
            if is_block and len({_owner(log.names[i]) for i in columns}) == 1:
                yield columns, float(np.median([rates[one][1] for one in places]))


def _owner(name: str) -> str:
    return name.rpartition("[")[0]


def _list_turns(log: AttributeLog, size: int) -> Iterator[tuple[str, Numbers]]:
    """Yield every orientation that attributes may be, and its inverse, as matrices. Shape (looks, size, size)."""
    for name, matrices in _list_matrices(log.names, log.values, size):
        yield name, matrices
        yield name, matrices.transpose(0, 2, 1)


def list_turns_of(names: Sequence[str], values: Numbers) -> Iterator[tuple[str, Numbers]]:
    """Yield every orientation that numbers may be, as matrices: angles about the vertical, quaternions, matrices, and
    three angles. Shape of values: (looks, names), of matrices: (looks, 3, 3)."""
    for name, level in _list_matrices(names, values, 2):
        matrices = np.tile(np.eye(3), (len(level), 1, 1))
        matrices[:, :2, :2] = level
        yield name, matrices
    yield from _list_matrices(names, values, 3)


def _list_matrices(names: Sequence[str], values: Numbers, size: int) -> Iterator[tuple[str, Numbers]]:
    owners: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        owners.setdefault(_owner(name) or name, []).append(column)
    for name, columns in owners.items():
        rows = values[:, columns]
        if size == 2:
            for place, column in enumerate(columns):
                if values[:, column].std() > LEAST_TURN / 2:
                    yield names[column], turn_plane(rows[:, place])
        for first in range(len(columns) - 3):
            quaternion = rows[:, first : first + 4]
            if np.abs(np.linalg.norm(quaternion, axis=1) - 1).max() < UNIT:
                for order in ((0, 1, 2, 3), (1, 2, 3, 0)):
                    yield name, _reduce(attitudes.compute_matrices(quaternion[:, order]), size)
        for first in range(len(columns) - 8 if size == 3 else 0):
            matrices = rows[:, first : first + 9].reshape(-1, 3, 3)
            if np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max() < UNIT:
                yield name, matrices
        for first in range(len(columns) - 2 if size == 3 else 0):
            angles = rows[:, first : first + 3]
            if np.abs(angles).max() < 20 and angles.std() > LEAST_TURN / 3:
                yield name, _turn_by_angles(angles)


def _reduce(matrices: Numbers, size: int) -> Numbers:
    """Return only the turn about the vertical for a velocity in the plane."""
    return matrices if size == 3 else turn_plane(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]))


def turn_plane(angles: Numbers) -> Numbers:
    """Return rotations in the plane, shape (n, 2, 2), by angles [rad], shape (n,)."""
    cosine, sine = np.cos(angles), np.sin(angles)
    return np.array([[cosine, -sine], [sine, cosine]]).transpose(2, 0, 1)


def _turn_by_angles(angles: Numbers) -> Numbers:
    """Return the rotations of roll, pitch and yaw about fixed axes [rad], shape (n, 3)."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles.T), np.sin(angles.T)
    rows = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return np.array(rows).transpose(2, 0, 1)


def _measure_rests(log: AttributeLog, velocity: Numbers, matrices: Numbers, falling: float) -> list[float]:
    """Return which part of what moves a body is left, 0 to 1, if it is pushed in a frame, in several ways: its
    acceleration follows from the actions; or its velocity in the frame does; or thrusts, against gravity or without it,
    act along some axes of the frame only. `falling` is what gravity adds to a velocity in a step."""
    steps = np.flatnonzero(log.is_step)
    before, after = velocity[steps - 1], velocity[steps]
    actions = np.hstack([np.ones((len(steps), 1)), log.actions[steps]])
    acceleration = after - before
    rests = [_find_rest(_list_pushes(log, velocity, matrices), acceleration.reshape(-1, 1))]
    inside = np.einsum("nji,nj->ni", matrices, velocity)
    inside_before, inside_after = inside[steps - 1], inside[steps]
    rests.append(_find_rest(np.hstack([inside_before, actions]), inside_after - inside_before))
    rests.append(_find_rest(actions, inside_after))
    rests += [_measure_thrusts(acceleration, matrices[steps - 1], fall) for fall in (0.0, falling)]
    return rests


def _list_pushes(log: AttributeLog, velocity: Numbers, matrices: Numbers) -> Numbers:
    """Return what may accelerate a body, per step and axis: the actions, turned; what brakes; and what is constant."""
    steps = np.flatnonzero(log.is_step)
    size = velocity.shape[1]
    actions = np.hstack([np.ones((len(steps), 1)), log.actions[steps]])
    pushed = np.einsum("nij,na->niaj", matrices[steps - 1], actions).reshape(len(steps) * size, -1)
    drag, constant = velocity[steps - 1].reshape(-1, 1), np.tile(np.eye(size), (len(steps), 1))
    return np.hstack([pushed, drag, constant])


def _measure_thrusts(acceleration: Numbers, matrices: Numbers, fall: float) -> float:
    """Return how far thrusts are from one axis of the frame; those of rotors are near one, also where they are late."""
    size = acceleration.shape[1]
    thrusts = np.einsum("nji,nj->ni", matrices, acceleration + fall * np.eye(size)[-1])
    sizes = np.linalg.eigvalsh(thrusts.T @ thrusts)
    return float(sizes[-2] / max(sizes[-1], 1e-12))


def _find_rest(columns: Numbers, wanted: Numbers) -> float:
    """Return which part of some numbers is left. Shapes (n, columns) and (n, k)."""
    weights = np.linalg.lstsq(columns, wanted, rcond=1e-8)[0]
    size = np.square(wanted - wanted.mean(axis=0)).sum()
    return float(np.square(wanted - columns @ weights).sum() / max(size, 1e-12))


def _falls(log: AttributeLog, velocity: Numbers, matrices: Numbers, falling: float) -> bool:
    """Say whether gravity acts along the last axis: with it, what pushes the body is explained."""
    steps = np.flatnonzero(log.is_step)
    acceleration = velocity[steps] - velocity[steps - 1]
    weights = np.linalg.lstsq(_list_pushes(log, velocity, matrices), acceleration.ravel(), rcond=1e-8)[0]
    with_it, without = (_measure_thrusts(acceleration, matrices[steps - 1], fall) for fall in (falling, 0.0))
    return bool(abs(weights[-1] / falling + 1) < SAME_GRAVITY or CLEARLY * with_it < without)
