"""Carts that are paid by kernels of a wrong quantity, or with the width in its place, next to their twins: NumPy."""

import math

import numpy as np
from robots import Robot

from rlctl.task import rewards

DT = 0.1  # [s]
WIDTH = 0.5  # [m]


def bell(x, width):
    return math.exp(-((x / width) ** 2))


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Cart(Robot):
    """It drives to a spot and turns as it has to stand there."""

    def size(self):
        return 8

    def start(self):
        draw = self.np_random.uniform
        self.place, self.heading, self.speed, self.turning = draw(-1, 1, 2), draw(-3, 3), 0.0, 0.0
        towards, self.course = draw(-3, 3), draw(-3, 3)
        self.spot = self.place + draw(0.5, 0.8) * np.array([math.cos(towards), math.sin(towards)])

    def move(self, action):
        self.speed = 0.8 * self.speed + 0.2 * action[0]
        self.turning = 0.8 * self.turning + 0.4 * action[1]
        self.heading += DT * self.turning
        self.place = self.place + DT * self.speed * np.array([math.cos(self.heading), math.sin(self.heading)])

    def observe(self):
        c, s = math.cos(self.heading), math.sin(self.heading)
        dx, dy = self.spot - self.place
        off = self.course - self.heading
        own = [c * dx + s * dy, c * dy - s * dx, math.sin(off), math.cos(off)]
        return np.array([*own, c, s, self.speed, self.turning], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.spot - self.place))

    def off_course(self):
        return abs(wrap(self.course - self.heading))

    def is_success(self):
        return self.distance() < 0.3

    def reward(self):
        d, turn = self.distance(), self.off_course()
        r_near = bell(d, WIDTH)
        r_turn = 0.3 * bell(turn, 0.6) * r_near
        return r_near + r_turn - 0.5


class CartNearByTurning(Cart):
    def reward(self):
        d, turn = self.distance(), self.off_course()
        r_near = bell(turn, WIDTH)
        r_turn = 0.3 * bell(turn, 0.6) * r_near
        return r_near + r_turn - 0.5 - 0.1 * d


class CartOfTerms(Cart):
    """Its terms are in a dictionary."""

    def reward(self):
        heading_error, distance = self.off_course(), self.distance()
        terms = {
            "proximity": float(np.exp(-distance / 0.4)),
            "alignment": 0.4 * float(np.exp(-2.0 * heading_error**2)),
            "rest": 0.2 * rewards.closeness(self.speed, 0.2) * rewards.closeness(distance, 0.1),
        }
        return sum(terms.values()) - 1.7


class RL643CartAlignedByDistance(CartOfTerms):
    def reward(self):
        heading_error, distance = self.off_course(), self.distance()
        terms = {
            "proximity": float(np.exp(-distance / 0.4)),
            "alignment": 0.4 * float(np.exp(-2.0 * distance**2)),
            "rest": 0.2 * rewards.closeness(self.speed, 0.2) * rewards.closeness(distance, 0.1),
        }
        return sum(terms.values()) - 1.7 - 0.1 * heading_error


class CartSwapsTheWidth(Cart):
    def reward(self):
        d, turn = self.distance(), self.off_course()
        r_near = bell(WIDTH, d)
        r_turn = 0.3 * bell(turn, 0.6)
        return r_near + r_turn - 0.5


class CartSwapsItInTerms(CartOfTerms):
    def reward(self):
        terms = {"proximity": rewards.closeness(0.4, self.distance()), "calm": -0.1 * self.turning**2}
        return sum(terms.values()) - 1.7


class CartShapesItsWidth(Cart):
    """The further it is, the wider is what it is paid for turning."""

    def reward(self):
        d, turn = self.distance(), self.off_course()
        return bell(d, WIDTH) + 0.2 * bell(turn, 0.3 + d) - 0.5
