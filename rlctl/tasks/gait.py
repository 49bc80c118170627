"""What a robot with legs needs to know of them to step, and to learn from its mirror image."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.tasks.legs import Leg, Skeleton
from rlctl.tasks.shapes import Array
from rlctl.tasks.stance import VERTICAL, Stance, compare_turns

_ALIKE = 1e-3  # [rad], of rounding
_ASYMMETRIC = 0.1  # of the largest acceleration; real robots have up to 0.05
_TRIALS = 3
_BEND, _SPEED = 0.1, 0.5  # [rad], [rad/s]: of the random states
_TORQUE = 3.0  # [N m], of 1 kg with legs of 1 m


@dataclasses.dataclass(frozen=True)
class Gait:
    """What a robot needs to know of its legs."""

    other_side: list[int]  # as `BatchTask.mirror` has it, of the legs' joints; empty if its sides are not alike
    faces_y: bool
    soles: list[float]  # heights of the feet's origins above the ground in the stance [m]
    aside: list[int]  # joints near the hip that do not turn about y
    asymmetry: float  # of how its sides accelerate, see `measure_asymmetry`; 0 if their joints are not alike


def describe_gait(skeleton: Skeleton, legs: Sequence[Leg], stance: Stance, mirror: Array) -> Gait:
    """Return it for legs that are pairs by `mirror`, one of `MIRRORS`; the skeleton is then in the stance."""
    joints = sorted(joint for leg in legs for joint in leg.joints)
    number = {joint: index for index, joint in enumerate(joints, 1)}
    other_side = dict.fromkeys(joints, 0)
    for leg in legs:
        other = legs[leg.other]
        for own, far, sign in zip(leg.joints, other.joints, compare_turns(skeleton, leg, other, mirror), strict=True):
            if abs(stance.positions[far] - sign * stance.positions[own]) < _ALIKE:
                other_side[own] = int(sign) * number[far]
    skeleton.place(skeleton.rest)
    across = np.abs(skeleton.axes(range(len(stance.positions)))[:, 1]) > VERTICAL
    skeleton.place(stance.positions)
    soles, aside = [], []
    for leg in legs:
        touch, anchors = skeleton.touch(leg.foot), skeleton.anchors(leg.joints)
        soles.append(float(skeleton.data.xpos[skeleton.body.find_link(leg.foot.link), 2] - touch[2]))
        near = anchors[:, 2] - touch[2] > stance.leg_length / 2
        aside += np.array(leg.joints)[near & ~across[leg.joints]].tolist()
    alike, asymmetry = list(other_side.values()) if all(other_side.values()) else [], 0.0
    if alike:
        asymmetry = measure_asymmetry(skeleton, stance, joints, alike, mirror)
        skeleton.place(stance.positions)
    if asymmetry > _ASYMMETRIC:
        alike = []
    return Gait(alike, bool(mirror[0] < 0), soles, sorted(aside), asymmetry)


def measure_asymmetry(
    skeleton: Skeleton, stance: Stance, joints: Sequence[int], other_side: Sequence[int], mirror: Array
) -> float:
    """Return by how much mirror images of states near the stance do not accelerate as mirror images.

    In flight, with random speeds and torques; the part of the largest acceleration, of the trunk's turning or of the
    joints. Masses and inertias that are no mirror images show here.
    """
    rng, chosen = np.random.default_rng(0), list(joints)
    places, signs = np.abs(other_side) - 1, np.sign(other_side)
    worst = 0.0
    for _ in range(_TRIALS):
        bend, speed, torque = (rng.uniform(-scale, scale, len(chosen)) for scale in (_BEND, _SPEED, 1.0))
        turning = rng.uniform(-_SPEED, _SPEED, 3)
        torque *= _TORQUE * skeleton.body.total_mass() * stance.leg_length
        reflected = [signs * values[places] for values in (bend, speed, torque)]
        ours = _accelerate(skeleton, stance.positions, chosen, turning, bend, speed, torque)
        theirs = _accelerate(skeleton, stance.positions, chosen, -mirror * turning, *reflected)
        expected = -mirror * ours[0], signs * ours[1][places]
        for actual, wanted in zip(theirs, expected, strict=True):
            worst = max(worst, float(np.abs(actual - wanted).max() / np.abs(wanted).max()))
    return worst


def _accelerate(
    skeleton: Skeleton, stance: Array, joints: list[int], turning: Array, bend: Array, speed: Array, torque: Array
) -> tuple[Array, Array]:
    """Return how the trunk's turning accelerates [rad/s^2], and the joints."""
    positions = stance.copy()
    positions[joints] += bend
    skeleton.place(positions)
    data, free = skeleton.data, skeleton.body.parts.free
    assert free is not None  # a skeleton's base is free
    first = free[1] + 3
    places = skeleton.model.jnt_dofadr[skeleton.joints[joints]]
    data.qvel[:] = data.qfrc_applied[:] = 0.0
    data.qvel[first : first + 3] = turning
    data.qvel[places], data.qfrc_applied[places] = speed, torque
    skeleton.forward()
    accelerations = data.qacc.copy()
    data.qvel[:] = data.qfrc_applied[:] = 0.0
    return accelerations[first : first + 3], accelerations[places]
