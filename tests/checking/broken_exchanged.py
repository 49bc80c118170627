"""Boats whose functions are given arguments in each other's place, next to twins that give them in the right one."""

import numpy as np
from robots import Boat

SLOW, FAST = np.array([-0.3, -0.8]), np.array([0.9, 0.8])


def beyond(values, lower, upper):
    """Return how far values are outside of limits; limits that are the wrong way round are none."""
    is_limited = lower <= upper
    return float(np.sum(is_limited * (np.maximum(lower - values, 0) + np.maximum(values - upper, 0))))


def scale(pressure, factor):
    return 0.5 * pressure + 0.1 * factor**2


class BoatKeepsSpeeds(Boat):
    """It pays for speeds outside of limits."""

    def reward(self):
        return super().reward() - self.excess()

    def excess(self):
        return beyond(self.speed, SLOW, FAST)


class RL645BoatKeepsNoSpeeds(BoatKeepsSpeeds):
    def excess(self):
        return beyond(self.speed, FAST, SLOW)


class BoatIsPushed(Boat):
    """Its engines press against the water."""

    def move(self, action):
        super().move(action)
        self.drag()

    def drag(self):
        pressure, factor = abs(self.speed[0]), 1.0 + self.speed[1] ** 2
        self.speed[1] *= 1 - 0.2 * scale(pressure, factor)


class RL645BoatIsPushedBySomethingElse(BoatIsPushed):
    def drag(self):
        pressure, factor = abs(self.speed[0]), 1.0 + self.speed[1] ** 2
        self.speed[1] *= 1 - 0.2 * scale(factor, pressure)


class BoatLooksBack(Boat):
    """Both sides are exchanged on purpose."""

    def reward(self):
        left, right = self.speed[0] + self.speed[1], self.speed[0] - self.speed[1]
        return super().reward() - 0.1 * self.lean(right, left)

    def lean(self, left, right):
        return abs(left - 2 * right)
