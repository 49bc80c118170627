"""Barges in the wind whose vectors are in a wrong frame or unit by one line, hoppers whose speeds are others than they
are called, and one whose legs fall through the ground; next to twins that are right."""

import numpy as np
from mujoco_robots import HOPPER, MujocoHopper
from robots import Robot

BOW = np.array([0.4, 0.0])  # from its middle [m]


def turn(vector, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


class Barge(Robot):
    """Its bow has to come to a berth; the wind blows from anywhere, it has no compass, and its motors are slow."""

    rlctl_ignore = {"RL110": "it hardly ever gets to the barrel"}
    joints = 3

    def size(self):
        return len(self.observe())

    def start(self):
        self.place, self.drift = self.np_random.uniform(-1, 1, 2), np.zeros(2)
        self.heading, self.turning, self.lean = self.np_random.uniform(-3, 3), 0.0, 0.0
        self.wind = self.np_random.uniform(-0.2, 0.2, 2)
        self.berth = self.place + self.np_random.uniform(-1.5, 1.5, 2)
        self.barrel = self.place + self.np_random.uniform(5.0, 6.0, 2)
        self.barrel_drift = np.zeros(2)
        self.motors = np.zeros(3)

    def __init__(self):
        self.place = self.berth = self.barrel = self.wind = self.drift = self.barrel_drift = np.zeros(2)
        self.heading = self.turning = self.lean = 0.0
        self.motors = np.zeros(3)
        super().__init__()

    def move(self, action):
        self.drive(action)
        if np.linalg.norm(self.barrel - self.place) < 0.3:
            self.barrel_drift = self.drift.copy()
        self.barrel = self.barrel + 0.1 * self.barrel_drift
        self.turning += 0.2 * (self.thrusts()[2] - self.turning)
        self.lean = 0.2 * self.turning
        self.heading += 0.1 * self.turning
        self.drift = turn(self.thrusts()[:2], self.heading) + 0.3 * self.wind - turn(self.leeway(), self.heading)
        self.place = self.place + 0.1 * self.drift

    def drive(self, command):
        self.motors += 0.5 * (command - self.motors)

    def thrusts(self):
        return np.array([0.5 * np.cos(self.lean) * self.motors[0], 0.2 * self.motors[1], self.motors[2]])

    def leeway(self):
        return 0.1 * turn(self.wind, -self.heading)

    def bow(self):
        return self.place + turn(BOW, self.heading)

    def inside(self, vector):
        c, s = np.cos(self.heading), np.sin(self.heading)
        x, y = vector
        return np.array([c * x + s * y, c * y - s * x])

    def felt_wind(self):
        return turn(self.wind, -self.heading)

    def barrel_speed(self):
        return turn(self.barrel_drift, -self.heading)

    def own_speed(self):
        return turn(self.drift, -self.heading)

    def turns(self):
        return self.turning

    def observe(self):
        ways = [turn(self.berth - self.bow(), -self.heading), self.inside(self.berth - self.place)]
        speeds = [self.own_speed(), self.barrel_speed(), self.felt_wind()]
        return np.concatenate([*ways, *speeds, [self.turns(), self.lean], self.motors]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm(self.berth - self.bow()))

    def is_success(self):
        return self.distance() < 0.1

    def reward(self):
        return -self.distance()


class RL129BargeFeelsTheWindOfTheWorld(Barge):
    def felt_wind(self):
        return 1.0 * self.wind


class RL125BargeHasItsBowBehind(Barge):
    def bow(self):
        return self.place + turn(BOW, -self.heading)


class RL125BargeForgetsASign(Barge):
    def inside(self, vector):
        c, s = np.cos(self.heading), np.sin(self.heading)
        x, y = vector
        return np.array([c * x + s * y, c * y + s * x])


class RL125BargeTurnsOneTheOtherWay(Barge):
    def barrel_speed(self):
        return turn(self.barrel_drift, self.heading)


class RL130BargeMovesItsSpeed(Barge):
    def own_speed(self):
        return turn(self.drift_velocity() - self.place, -self.heading)

    def drift_velocity(self):
        return self.drift


class RL134BargeTurnsInDegrees(Barge):
    def turns(self):
        return np.degrees(self.turning)


class BargeTurnsInPartsOfATurn(Barge):
    def turns(self):
        return np.degrees(self.turning) / 180


class RL701BargePushesTwice(Barge):
    def thrusts(self):
        return np.array([0.5 * np.cos(self.lean) * self.motors[0], 0.2 * self.motors[0], self.motors[2]])


class HopperWatchesItself(MujocoHopper):
    """It observes the parts of its velocity by their names."""

    def spin(self):
        gyro = self.data.qvel[3:6].copy()
        return 0.25 * gyro

    def observe(self):
        return np.concatenate([super().observe(), self.spin()])


class RL640HopperWatchesAnotherPart(HopperWatchesItself):
    def spin(self):
        gyro = self.data.qvel[2:5].copy()
        return 0.25 * gyro


class RL819HopperBrakesItsBase(MujocoHopper):
    def torques(self, action):
        stiffness, damping = self.gains
        return stiffness * (self.home + 0.4 * action - self.positions()) - damping * self.data.qvel[:6]


class RL843HopperSinks(MujocoHopper):
    rlctl_ignore = {"RL110": "it does not turn sideways"}

    xml = HOPPER.replace('size=".05 .03 .015"', 'size=".05 .03 .015" contype="0" conaffinity="0"').replace(
        'type="capsule"', 'type="capsule" contype="0" conaffinity="0"'
    )
