"""Declarations of a mirror symmetry with one mistake each, which shows only in the simulation."""

from rlctl_locomotion.walk import Walk

SIDES_ONLY = (4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9)


class RL120MirrorsTurning(Walk):
    mirror = {**Walk.mirror, "gyroscope": (-1, 2, -3)}


class RL120MirrorsTurningLikeVectors(Walk):
    mirror = {**Walk.mirror, "gyroscope": (1, -2, 3)}


class RL120TurnsHipsTheSameWay(Walk):
    mirror = {**Walk.mirror, "action": SIDES_ONLY, "last_action": SIDES_ONLY}


class RL120PrefersItsLeft(Walk):
    rlctl_ignore = {**Walk.rlctl_ignore, "RL632": "it follows its yaw rate only"}

    def rewards(self, action):
        return {**super().rewards(action), "tracking": 10.0 * self.turning[:, 2]}


class MeasuresItsLeft(Walk):
    reward_weights = {**Walk.reward_weights, "leftwards": 0.0}

    def rewards(self, action):
        return {**super().rewards(action), "leftwards": 10.0 * self.turning[:, 2]}
