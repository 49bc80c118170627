"""Boats and valves whose reward has a difference of two directions, next to twins that wrap it."""

import math

import numpy as np
from robots import Boat, Robot


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class BoatPoints(Boat):
    """It is paid for pointing to its buoy."""

    def bearing(self):
        return math.atan2(self.buoy[1] - self.place[1], self.buoy[0] - self.place[0])

    def off_course(self):
        return abs(wrap(self.bearing() - self.heading))

    def reward(self):
        return math.exp(-self.off_course()) - 0.5 * self.distance()


class RL618BoatPointsTheLongWay(BoatPoints):
    rlctl_ignore = {"RL605": "it is paid for pointing there as well"}

    def off_course(self):
        return abs(self.bearing() - self.heading)


class BoatShowsItsError(BoatPoints):
    """It observes by how much it is off its course."""

    def start(self):
        super().start()
        self.heading = wrap(self.heading)

    def move(self, action):
        super().move(action)
        self.heading = wrap(self.heading)

    def size(self):
        return 4

    def error(self):
        return wrap(self.bearing() - self.heading)

    def observe(self):
        return np.array([self.distance(), self.error(), *self.speed], np.float32)


class RL133BoatShowsTheLongWay(BoatShowsItsError):
    rlctl_ignore = {"RL117": "it jumps there", "RL605": "it is paid for pointing there as well"}

    def error(self):
        return self.bearing() - self.heading


class Valve(Robot):
    """It is to be turned to an angle near that of its start, in steps that do not matter."""

    joints = 1

    def start(self):
        self.angle = self.np_random.uniform(-np.pi, np.pi)
        self.goal = {"angle": wrap(self.angle + self.np_random.uniform(-1.5, 1.5))}
        self.rate = 0.0

    def size(self):
        return 5

    def observe(self):
        wanted = self.goal["angle"]
        is_shown = [math.sin(self.angle), math.cos(self.angle), np.sin(wanted), np.cos(wanted)]
        return np.array([*is_shown, self.rate], np.float32)

    def move(self, action):
        self.rate += 0.3 * (float(action[0]) - self.rate)
        self.angle += 0.1 * self.rate

    def error(self):
        return 1 - math.cos(self.goal["angle"] - self.angle)

    def is_success(self):
        return math.cos(self.goal["angle"] - self.angle) > 0.999

    def reward(self):
        return -self.error()


class RL618ValveTurnsTheLongWay(Valve):
    def error(self):
        return (self.goal["angle"] - self.angle) ** 2


class ValveHasStops(Valve):
    """It does not turn round: its angles are no directions, and differences of them may be large."""

    def observe(self):
        return np.array([self.angle, self.goal["angle"], self.rate, 0.0, 0.0], np.float32)

    def start(self):
        super().start()
        self.goal = {"angle": self.np_random.uniform(-np.pi, np.pi)}

    def move(self, action):
        self.rate += 0.3 * (float(action[0]) - self.rate)
        self.angle = float(np.clip(self.angle + 0.1 * self.rate, -np.pi, np.pi))

    def error(self):
        return abs(self.goal["angle"] - self.angle)

    def is_success(self):
        return self.error() < 0.05
