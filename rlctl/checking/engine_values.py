"""What the engine has of the bodies of a world in all looks, and which elements of the observation it explains."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from rlctl.checking import attitudes
from rlctl.checking.world_logs import WorldLog
from rlctl.checking.worlds import ANGULAR, CENTRE, FRAME, JOINTS, LINEAR, ORIENTATION, TURN, TURNING, VELOCITY, Array

LEAST_MOTION = 1e-3  # standard deviation; calmer values explain nothing [m], [rad], [m/s], [rad/s]
EXACT, EXACT_FACTOR = 1e-6, 1e-3
"""Part of an element's variance that is left, and the relative error of its factor, of an element without noise."""
NOISY, NOISY_FACTOR = 0.1, 0.03  # the same with noise
WHITE = 0.25  # correlation of what is left with what was left one step before: noise has none


@dataclasses.dataclass(frozen=True)
class EngineValue:
    """One number that the engine has."""

    name: str  # `velocity of hand of arm`
    is_angle: bool  # [rad], or [rad/s]; otherwise [m], or [m/s]
    is_speed: bool


@dataclasses.dataclass(frozen=True, eq=False)
class EngineValues:
    """Numbers of the engine in all looks."""

    names: list[EngineValue]
    rows: Array  # Shape (looks, numbers)

    @classmethod
    def read(cls, logs: Sequence[WorldLog]) -> "EngineValues":
        """Read logs of one world: joints, angles of free bodies, and places and velocities of links, in the world and
        in their own frame. Empty where it has not the same bodies in all of them."""
        looks = [(*states, rows) for log in logs for states, rows in zip(log.states, log.points, strict=True)]
        if len({tuple(part.shape for part in look) for look in looks}) != 1:
            return cls([], np.zeros((len(looks), 0)))
        names: list[EngineValue] = []
        columns: list[Array] = []

        def add(what: str, rows: Array, *, is_angle: bool, is_speed: bool) -> None:
            names.extend([EngineValue(what, is_angle, is_speed)] * rows.shape[1])
            columns.append(rows)

        for number, body in enumerate(logs[0].world.bodies):
            states = np.array([state[number] for log in logs for state in log.states])
            for place, joint in enumerate(body.joints):
                for is_speed, what in enumerate(("position", "speed")):
                    rows = states[:, [JOINTS + place + is_speed * len(body.joints)]]
                    name = f"{what} of joint {joint.name}"
                    add(name, rows, is_angle=joint.is_angle, is_speed=bool(is_speed))
            if body.is_free:
                turns = np.array([poses[body.id, -1][ORIENTATION] for log in logs for poses in log.poses])
                for angle, rows in zip(attitudes.NAMES, attitudes.compute_attitudes(turns).T, strict=True):
                    is_angle = angle.startswith(("roll", "pitch", "yaw"))
                    if is_angle:
                        add(f"{angle} of {body.name}", rows[:, None], is_angle=True, is_speed=False)
                add(f"velocity of {body.name}", states[:, VELOCITY], is_angle=False, is_speed=True)
                add(f"angular velocity of {body.name}", states[:, ANGULAR], is_angle=True, is_speed=True)
        points = np.array([rows for log in logs for rows in log.points])
        for name, rows in zip(logs[0].reader.name_points(), points.transpose(1, 0, 2), strict=True):
            arms = rows[:, FRAME] - rows[:, CENTRE]
            at_frame = rows[:, LINEAR] + np.cross(rows[:, TURNING], arms)
            add(f"position of {name}", rows[:, FRAME], is_angle=False, is_speed=False)
            add(f"position of the centre of {name}", rows[:, CENTRE], is_angle=False, is_speed=False)
            for what, is_angle, vectors in (
                (f"velocity of {name}", False, at_frame),
                (f"velocity of the centre of {name}", False, rows[:, LINEAR]),
                (f"angular velocity of {name}", True, rows[:, TURNING]),
            ):
                add(what, vectors, is_angle=is_angle, is_speed=True)
                inside = attitudes.rotate(rows[:, TURN], vectors)[:, :3]
                add(f"{what} in its own frame", inside, is_angle=is_angle, is_speed=True)
        return cls(names, np.nan_to_num(np.hstack([np.zeros((len(looks), 0)), *columns])))


@dataclasses.dataclass(frozen=True)
class ScaledValue:
    """An element of the observation that is a value of the engine times a factor, but for its episode's constant."""

    column: int
    value: EngineValue
    factor: float  # not below 0
    is_exact: bool  # without noise

    def has_factor(self, factor: float) -> bool:
        """Say whether its factor is the given one, as far as noise allows to tell."""
        return math.isclose(self.factor, factor, rel_tol=EXACT_FACTOR if self.is_exact else NOISY_FACTOR)


def center(values: Array, sizes: Sequence[int]) -> Array:
    """Subtract from the rows of each episode, which have the given sizes, their mean."""
    parts = np.split(values, np.cumsum(sizes)[:-1])
    return np.concatenate([part - part.mean(axis=0) for part in parts])


def find_scaled(values: EngineValues, observed: Array, sizes: Sequence[int]) -> list[ScaledValue]:
    """Return the elements that a value of the engine explains, each with the value that explains it best."""
    centered, rows = center(observed, sizes), center(values.rows, sizes)
    moving = np.flatnonzero(rows.std(axis=0) > LEAST_MOTION)
    columns = np.flatnonzero(centered.std(axis=0) > 1e-6 * (1 + np.abs(observed).max(axis=0)))
    if not moving.size or not columns.size:
        return []
    factors, left = explain(centered[:, columns], rows[:, moving])
    found = []
    for place, column in enumerate(columns.tolist()):
        best = int(left[:, place].argmin())
        factor, rest = float(factors[best, place]), float(left[best, place])
        is_noise = rest <= NOISY and is_white(centered[:, column] - factor * rows[:, moving[best]])
        if rest <= EXACT or is_noise:
            found.append(ScaledValue(column, values.names[int(moving[best])], abs(factor), rest <= EXACT))
    return found


def explain(centered: Array, rows: Array) -> tuple[Array, Array]:
    """Return by which factor each row explains each column, and which part of the column's variance is left. Shape
    (values, elements) each."""
    products, squares = rows.T @ centered, np.square(rows).sum(axis=0)[:, None]
    factors = products / squares
    left = 1 - factors * products / np.square(centered).sum(axis=0)
    return factors, left


def is_white(rest: Array) -> bool:
    """Say whether what is left looks like noise."""
    size = float(rest @ rest)
    return size > 0 and abs(float(rest[1:] @ rest[:-1])) <= WHITE * size
