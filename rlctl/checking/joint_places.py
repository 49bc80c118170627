"""Coordinates that follow the position of one joint, and between what values the limits of the joint keep them."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking import mujoco_worlds
from rlctl.checking.bullet_worlds import read_world
from rlctl.checking.worlds import Joint
from rlctl.environments.bullet_clients import ClientCalls
from rlctl.environments.simulations import find_mujoco

Array = NDArray[np.float64]

LEAST_MOTION, LEAST_TURN = 1e-3, 0.1  # of a joint [m], [rad]; over less, a sine is as straight
EXACT = 1e-4  # part of the range of a coordinate, and of a slope
UNITS = (1.0, 180.0 / np.pi)  # of an angle per radian


@dataclasses.dataclass(frozen=True, eq=False)
class JointSpan:
    """Between what values a joint keeps a coordinate."""

    joint: str
    low: float
    high: float
    period: float  # what a whole turn adds to it; infinite for a slide


def read_limited_joints(env: Any, clients: Iterable[int]) -> list[tuple[str, Joint, float]]:
    """Return name and position of the joints with limits, in clients of PyBullet and in MuJoCo [rad], [m]."""
    found: list[tuple[str, Joint, float]] = []
    for client in clients:
        for body in read_world(client).bodies:
            states = ClientCalls(client).getJointStates(body.id, [joint.index for joint in body.joints]) or ()
            found += [(body.name_joint(one), one, state[0]) for one, state in zip(body.joints, states, strict=False)]
    if (simulation := find_mujoco(env)) is not None:
        model, data = simulation
        for body in mujoco_worlds.read_world(model).bodies:
            places = [float(data.qpos[model.jnt_qposadr[joint.index]]) for joint in body.joints]
            found += [(body.name_joint(one), one, place) for one, place in zip(body.joints, places, strict=True)]
    return [one for one in found if one[1].has_limits]


def find_span(values: Array, looks: Sequence[Sequence[tuple[str, Joint, float]]]) -> JointSpan | None:
    """Return how the first joint limits a coordinate that is its position, times a factor, from somewhere on. Shape of
    the values: (n,), for n looks at all joints; NaN where the coordinate is not known."""
    known = np.isfinite(values)
    if len({len(look) for look in looks}) != 1 or known.sum() < 2 or np.ptp(values[known]) == 0:
        return None
    for number, (name, joint, _) in enumerate(looks[0]):
        positions = np.array([look[number][2] for look in looks])[known]
        if np.ptp(positions) < (LEAST_TURN if joint.is_angle else LEAST_MOTION):
            continue
        slope, offset = np.polyfit(positions, values[known], 1)
        error = np.abs(offset + slope * positions - values[known]).max()
        is_unit = any(abs(abs(slope) - unit) < EXACT * unit for unit in UNITS)
        if error < EXACT * np.ptp(values[known]) and (is_unit or not joint.is_angle):
            ends = sorted(float(offset + slope * end) for end in (joint.low, joint.high))
            return JointSpan(name, ends[0], ends[1], 2 * np.pi * abs(slope) if joint.is_angle else np.inf)
    return None
