"""Boats with angles in degrees and radians, next to twins that convert them rightly. They are written in different
ways: attributes, constants with a comment, dictionaries, helper functions, rotations of SciPy, gains."""

import math

import numpy as np
from robots import Boat

LIMITS = {"heading_deg": 150.0}
DRIFT = 0.5  # deg
FARTHEST, MOST_HEEL = 2.0, 15.0
D2R = math.pi / 180.0


def to_radians(angle):
    return angle * np.pi / 180


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class BoatUpTheRiver(Boat):
    """It may not turn round."""

    def reward(self):
        return super().reward() - float(self.has_turned())

    def has_turned(self):
        return abs(np.degrees(wrap(self.heading))) > LIMITS["heading_deg"]


class RL132BoatUpTheRiverInRadians(BoatUpTheRiver):
    def has_turned(self):
        return abs(wrap(self.heading)) > LIMITS["heading_deg"]


class RL132BoatUpTheRiverTwice(BoatUpTheRiver):
    def has_turned(self):
        heading = math.degrees(wrap(self.heading))
        return abs(math.degrees(heading)) > LIMITS["heading_deg"]


class RL132BoatUpTheRiverBackwards(BoatUpTheRiver):
    def has_turned(self):
        return abs(to_radians(wrap(self.heading))) > LIMITS["heading_deg"] * D2R


class BoatByCompass(Boat):
    """Its compass has noise."""

    def observe(self):
        shown = super().observe()
        heading = wrap(self.heading) + self.np_random.normal(0, np.deg2rad(DRIFT))
        shown[2:4] = np.sin(heading), np.cos(heading)
        return shown


class RL132BoatByCompassInRadians(BoatByCompass):
    def observe(self):
        shown = super().observe()
        heading = wrap(self.heading) + self.np_random.normal(0, DRIFT)
        shown[2:4] = np.sin(heading), np.cos(heading)
        return shown


class BoatKeepsItsCourse(Boat):
    """A rudder turns it to the buoy, with a gain per degree."""

    gain_per_deg = 0.004

    def move(self, action):
        super().move(action)
        x, y = self.buoy - self.place
        error = np.degrees(wrap(np.arctan2(y, x) - self.heading))
        self.heading += self.gain_per_deg * error


class RL132BoatKeepsItsCoursePerDegree(BoatKeepsItsCourse):
    def move(self, action):
        Boat.move(self, action)
        x, y = self.buoy - self.place
        self.heading += self.gain_per_deg * wrap(np.arctan2(y, x) - self.heading)


class BoatLooksAside(Boat):
    """It is paid a little for where its lamp shines, which is turned by up to 20 degrees."""

    def start(self):
        super().start()
        self.lamp_deg = self.np_random.uniform(-20, 20)

    def reward(self):
        x, y = self.buoy - self.place
        shines = self.heading + np.deg2rad(self.lamp_deg)
        return super().reward() + 0.05 * (np.cos(shines) * x + np.sin(shines) * y)


class RL126BoatLooksAsideInDegrees(BoatLooksAside):
    rlctl_ignore = {"RL114": "what it observes of its lamp is not the angle that it is paid for"}

    def reward(self):
        x, y = self.buoy - self.place
        c, s = math.cos(self.lamp_deg), math.sin(self.lamp_deg)
        return Boat.reward(self) + 0.05 * (c * x + s * y)


class BoatHeels(Boat):
    """It leans over where it turns, and may not lean far."""

    def __init__(self, most=40.0):
        self.most = most
        super().__init__()

    def start(self):
        super().start()
        self.heel = 0.0

    def move(self, action):
        super().move(action)
        self.heel += 0.2 * (self.speed[1] - self.heel)

    def observed(self):
        return (*super().observed(), "sin heel", "cos heel")

    def observe(self):
        return np.append(super().observe(), [np.sin(self.heel), np.cos(self.heel)]).astype(np.float32)

    def is_success(self):
        return super().is_success() and self.distance() < FARTHEST and self.is_upright()

    def is_upright(self):
        return abs(self.heel) < np.deg2rad(MOST_HEEL)


class RL132BoatHeelsAnyhow(BoatHeels):
    rlctl_ignore = {"RL204": "a numpy.bool works everywhere"}

    def is_upright(self):
        return abs(self.heel) < MOST_HEEL


class BoatHeelsBetweenKeywords(BoatHeels):
    def is_upright(self):
        return -self.most < self.heel < self.most


class BoatLooksAnywhere(BoatHeels):
    def is_upright(self):
        x, y = self.buoy - self.place
        error = wrap(math.atan2(y, x) - self.heading)
        return not abs(error) > 30


class BoatLooksAhead(BoatHeels):
    """Its limit is in degrees, as what it is compared with; a round number of radians guards its heel."""

    def is_upright(self):
        x, y = self.buoy - self.place
        error = math.degrees(wrap(math.atan2(y, x) - self.heading))
        return abs(error) < self.most and abs(self.heel) < 100.0
