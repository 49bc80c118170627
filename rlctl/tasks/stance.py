"""The stance of a robot with legs: joint positions in which it stands, searched by kinematics alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from rlctl.tasks.legs import Leg, Skeleton
from rlctl.tasks.shapes import Array

_BENT, _BENT_OF_TWO = 0.77, 0.88  # of the longest leg: height of the hip in the stance; on two legs
_SPRAWLED = (0.5, 0.55)  # of the longest leg: height of the hip, distance of the foot to its side
_LONGEST = 0.95  # of the longest leg, where legs differ
_STRETCHED = 0.97  # of a stretched leg on a level sole; long feet that point down make the longest leg much longer
_MARGIN = 0.05  # of a joint's range, to its limits
_ALIKE = 0.03  # of the longest leg: how far apart a leg and the mirror image of the other one may be
_SMALL = 0.005  # [rad], from a joint's rest
_ASIDE = 0.3  # of the longest leg: how far a foot may be to the side of its hip
_SAMPLES = 300
_STARTS = 2
VERTICAL = 0.8  # of an axis' length: how much of it is along z, or y
_LEAST_KNEE = 0.1  # of the longest leg: height of a knee above the ground


@dataclasses.dataclass(frozen=True)
class Stance:
    """Where the joints are, and what follows from it; heights are those of the trunk's centre of mass [m]."""

    positions: Array  # of all joints [rad or m]
    height: float  # above the ground
    clearance: float  # of the trunk's lowest point
    leg_length: float  # mean distance from hip to foot [m]
    unevenness: float  # largest difference of the feet's heights [m]


def measure_stance(skeleton: Skeleton, legs: Sequence[Leg], positions: Array) -> Stance:
    """Return the stance of given joint positions."""
    skeleton.place(positions)
    feet = np.array([skeleton.touch(leg.foot) for leg in legs])
    ground = float(feet[:, 2].mean())
    hips = np.array([skeleton.anchors([leg.joints[_find_hip(skeleton, leg)]])[0] for leg in legs])
    length = float(np.linalg.norm(hips - feet, axis=1).mean())
    return Stance(positions, -ground, skeleton.lowest_of_trunk() - ground, length, float(np.ptp(feet[:, 2])))


def _find_hip(skeleton: Skeleton, leg: Leg) -> int:
    """Return which joint of a leg is where the thigh begins: the first that turns about y, else about x, else any."""
    across = np.abs(skeleton.axes(leg.joints)) > VERTICAL
    for axis in (1, 0):
        if across[:, axis].any() and len(across) - across[:, axis].argmax() > 1:
            return int(across[:, axis].argmax())
    return 0


def compare_turns(skeleton: Skeleton, leg: Leg, other: Leg, mirror: Array) -> Array:
    """Return 1 for each joint of a leg that turns as the mirror image of that of the other leg, -1 for the others."""
    skeleton.place(skeleton.rest)
    own, others = skeleton.axes(leg.joints), skeleton.axes(other.joints)
    # The mirror image of a rotation turns the other way.
    signs: Array = np.sign(-np.sum(own * others * mirror, axis=1))
    return signs


class StanceSearch:
    """Searches a stance: feet level and below the hips, or to the side of hips that turn about z, and knees bent."""

    def __init__(self, skeleton: Skeleton, legs: Sequence[Leg], mirror: Array) -> None:
        self.skeleton, self.legs, self.mirror = skeleton, legs, mirror
        margin = _MARGIN * (skeleton.high - skeleton.low)
        self.low, self.high = skeleton.low + margin, skeleton.high - margin
        self.pose = skeleton.rest.copy()
        skeleton.place(self.pose)
        self.sprawled = [len(legs) > 2 and abs(skeleton.axes(leg.joints)[0, 2]) > VERTICAL for leg in legs]
        self.hips = [0 if flat else _find_hip(skeleton, leg) for flat, leg in zip(self.sprawled, legs, strict=True)]
        self.across = [np.abs(skeleton.axes(leg.joints)[:, 1]) > VERTICAL for leg in legs]
        self.rest_frames = [self._find_frame(leg).copy() for leg in legs]
        self.soles = [self._has_sole(leg) for leg in legs]
        self.samples = [self._sample(leg) for leg in legs]
        self.lengths = [self._measure_longest(index) for index in range(len(legs))]
        self.ground = self._choose_ground()
        self.shift = 0.0

    @property
    def longest(self) -> float:
        """The largest distance from hip to foot [m], the mean of all legs."""
        return float(np.mean(self.lengths))

    def find(self) -> Stance:
        """Return a stance; right legs are the mirror images of left ones.

        The feet are below the robot's centre of mass, along x on average, unless the legs are sprawled.
        """
        positions = self._solve(0.0)
        if not any(self.sprawled):
            self.skeleton.place(positions)
            feet = np.mean([self.skeleton.touch(leg.foot) for leg in self.legs], axis=0)
            positions = self._solve(float((self.skeleton.centre_of_mass() - feet)[0]))
        return measure_stance(self.skeleton, self.legs, np.round(positions, 3) + 0.0)  # no -0.0

    def _has_sole(self, leg: Leg) -> bool:
        """Return whether a foot is long and has an ankle that can hold it level."""
        skeleton, foot = self.skeleton, leg.foot
        places = skeleton.data.xpos[foot.bodies] + np.einsum(
            "nij,nj->ni", skeleton.data.xmat[foot.bodies].reshape(-1, 3, 3), foot.points
        )
        heights = places[:, 2] - foot.radii
        lowest = places[heights < heights.min() + skeleton.thickness(foot)]
        return len(leg.joints) > 3 and bool(np.ptp(lowest[:, 0]) > 0.5 * np.ptp(places[:, 0]) > 0)

    def _find_frame(self, leg: Leg) -> Array:
        frame: Array = self.skeleton.data.xmat[leg.foot.bodies[-1]].reshape(3, 3)
        return frame

    def _sample(self, leg: Leg) -> Array:
        return np.random.default_rng(0).uniform(
            self.low[leg.joints], self.high[leg.joints], (_SAMPLES, len(leg.joints))
        )

    def _place(self, leg: Leg, angles: Array) -> tuple[Array, Array]:
        """Move a leg; return its joints' places and its foot's [m]."""
        self.pose[leg.joints] = angles
        self.skeleton.place(self.pose)
        return self.skeleton.anchors(leg.joints), self.skeleton.touch(leg.foot)

    def _measure_longest(self, index: int) -> float:
        leg, hip = self.legs[index], self.hips[index]
        places = [self._place(leg, angles) for angles in self.samples[index]]
        self.pose[leg.joints] = self.skeleton.rest[leg.joints]
        return max(float(np.linalg.norm(foot - anchors[hip])) for anchors, foot in places)

    def _choose_ground(self) -> float:
        """Return the height of the ground below the trunk's centre of mass, negative [m]."""
        self.skeleton.place(self.pose)
        hips = np.array(
            [self.skeleton.anchors([leg.joints[hip]])[0, 2] for leg, hip in zip(self.legs, self.hips, strict=True)]
        )
        lengths = np.array(self.lengths)
        bent = np.where(self.sprawled, _SPRAWLED[0], _BENT_OF_TWO if len(self.legs) == 2 else _BENT)
        stretched = np.array([self._measure_stretched(index) for index in range(len(self.legs))])
        highest = (
            (hips - bent * lengths).mean(),
            (hips - _LONGEST * lengths).max(),
            (hips - _STRETCHED * stretched).max(),
        )
        return float(max(highest))

    def _measure_stretched(self, index: int) -> float:
        """Return how far below its hip a level sole is while the leg is stretched [m]; without a sole infinite."""
        if not self.soles[index]:
            return np.inf
        leg = self.legs[index]
        anchors, foot = self._place(leg, self.skeleton.rest[leg.joints])
        bones = np.linalg.norm(np.diff(anchors[self.hips[index] :, ::2], axis=0), axis=1)  # seen from the side
        return float(bones.sum() + anchors[-1, 2] - foot[2])

    def _solve(self, shift: float) -> Array:
        """Return positions of all joints, with feet shifted along x [m]."""
        self.shift = shift
        solved: dict[int, Array] = {}
        for index, leg in enumerate(self.legs):
            if leg.other not in solved:
                solved[index] = self._minimize(index, lambda angles, index=index: self._judge(index, angles))
                continue
            places = np.vstack(self._place(self.legs[leg.other], solved[leg.other]))
            self.skeleton.place(self.skeleton.rest)
            middle = self.skeleton.anchors([leg.joints[0], self.legs[leg.other].joints[0]]).mean(axis=0)
            image = np.where(self.mirror < 0, 2 * middle - places, places)
            solved[index] = self._reflect(index, solved[leg.other], image)
        for index, leg in enumerate(self.legs):
            self.pose[leg.joints] = solved[index]
        return self.pose.copy()

    def _reflect(self, index: int, angles: Array, image: Array) -> Array:
        """Return the angles of a leg for those of the other one, whose joints' and foot's mirror `image` is known."""
        leg = self.legs[index]
        same = compare_turns(self.skeleton, leg, self.legs[leg.other], self.mirror) * angles
        inside = (self.low[leg.joints] <= same) & (same <= self.high[leg.joints])
        if inside.all() and np.abs(self._compare(index, same, image)).max() < 10 * _ALIKE:
            return same
        return self._minimize(index, lambda angles: self._compare(index, angles, image))

    def _minimize(self, index: int, judge: Any) -> Array:
        """Return the angles with the least sum of squares, from the best samples on."""
        from scipy.optimize import least_squares

        leg = self.legs[index]
        samples, rest = self.samples[index], self.skeleton.rest[leg.joints]
        order = np.argsort([float(np.sum(judge(angles) ** 2)) for angles in samples])
        bends = samples[order, -1] > rest[-1]  # both ways to bend a knee
        starts = [samples[order][bends == bend][:_STARTS] for bend in (False, True)]
        bounds = self.low[leg.joints], self.high[leg.joints]
        results = [least_squares(judge, start, bounds=bounds) for start in np.concatenate(starts)]
        best: Array = min(results, key=lambda result: float(result.cost)).x
        return np.where(np.abs(best - rest) < _SMALL, rest, best)

    def _judge(self, index: int, angles: Array) -> Array:
        """Return by how much a leg misses what a stance needs; what is in the front has priority."""
        leg, length = self.legs[index], self.lengths[index]
        anchors, foot = self._place(leg, angles)
        to_foot = (foot - anchors[self.hips[index]]) / length
        level = 10 * (foot[2] - self.ground) / length
        knees = anchors[self.hips[index] + 1 :]
        buried = 10 * np.maximum(0.0, _LEAST_KNEE - (knees[:, 2] - self.ground) / length)
        effort = 0.05 * (angles - self.skeleton.rest[leg.joints]) / np.pi
        if self.sprawled[index]:
            effort[0] *= 10.0
            outwards = anchors[0, :2] / np.linalg.norm(anchors[0, :2])
            reach = 3 * (np.linalg.norm(to_foot[:2]) - _SPRAWLED[1]), 3 * min(0.0, float(to_foot[:2] @ outwards))
            return np.array([level, *reach, *buried, *effort])
        # Knees of two legs bend forwards, of four backwards.
        forwards = 1.0 if len(self.legs) == 2 else -1.0
        bend = 0.3 * np.maximum(0.0, -forwards * (knees[:, 0] - anchors[self.hips[index], 0]) / length)
        # Sideways it may be where it is while the joints above the thigh are at rest.
        effort[: self.hips[index]] *= 20.0
        if len(self.legs) == 2:
            effort[~self.across[index]] *= 5.0  # legs that are not twisted
        aside = (0.2 if len(self.legs) == 2 else 0.05) * to_foot[1] + 3 * max(0.0, abs(to_foot[1]) - _ASIDE)
        below = 3 * (to_foot[0] - self.shift / length), aside
        # From the rest on, where a sole is level: the axes of the file's frame may point anywhere.
        turned = self._find_frame(leg) @ self.rest_frames[index].T
        tilt = 3 * turned[2, :2] if self.soles[index] else np.zeros(2)
        toe_out = turned[1, 0] if len(self.legs) == 2 else 0.0
        return np.array([level, *below, *tilt, toe_out, *buried, *bend, *effort])

    def _compare(self, index: int, angles: Array, image: Array) -> Array:
        """Return by how much a leg differs from the mirror image of the other one."""
        anchors, foot = self._place(self.legs[index], angles)
        effort = 1e-3 * (angles - self.skeleton.rest[self.legs[index].joints])
        miss: Array = 10 * (np.vstack([anchors, foot]) - image) / self.lengths[index]
        # Along its axis, the place of a joint is a choice of the file's.
        axes = self.skeleton.axes(self.legs[index].joints)
        miss[:-1] -= np.sum(miss[:-1] * axes, axis=1, keepdims=True) * axes
        return np.array([*miss.ravel(), *effort])
