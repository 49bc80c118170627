"""What a robot with legs needs to know of them to step, and to learn from its mirror image."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.tasks.legs import Leg, Skeleton
from rlctl.tasks.shapes import Array
from rlctl.tasks.stance import VERTICAL, Stance, compare_turns

_ALIKE = 1e-3  # [rad], of rounding


@dataclasses.dataclass(frozen=True)
class Gait:
    """What a robot needs to know of its legs."""

    other_side: list[int]  # as `BatchTask.mirror` has it, of the legs' joints; empty if its sides are not alike
    faces_y: bool
    soles: list[float]  # heights of the feet's origins above the ground in the stance [m]
    aside: list[int]  # joints near the hip that do not turn about y


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
    alike = list(other_side.values()) if all(other_side.values()) else []
    return Gait(alike, bool(mirror[0] < 0), soles, sorted(aside))
