"""Robots that are paid for the length of a velocity where its part ahead is meant, next to their twins: NumPy."""

import math

import numpy as np
from robots import Robot

DT = 0.1  # [s]


class Hovercraft(Robot):
    """It slides in all directions, turns, and is to go ahead, or along a street, with a speed that it is told."""

    joints = 3

    def size(self):
        return 9

    def start(self):
        draw = self.np_random.uniform
        self.place, self.velocity = draw(-1, 1, 2), np.zeros(2)
        self.heading, self.turning = draw(-3, 3), 0.0
        self.street, self.told = draw(-3, 3), draw(0.2, 0.5)
        self.begin = self.place.copy()

    def move(self, action):
        c, s = math.cos(self.heading), math.sin(self.heading)
        pushed = np.array([c * action[0] - s * action[1], s * action[0] + c * action[1]])
        self.velocity = 0.9 * self.velocity + 0.2 * pushed
        self.place = self.place + DT * self.velocity
        self.turning = 0.8 * self.turning + 0.3 * action[2]
        self.heading += DT * self.turning

    def observe(self):
        c, s = math.cos(self.heading), math.sin(self.heading)
        vx, vy = self.velocity
        off = self.street - self.heading
        own = [c * vx + s * vy, c * vy - s * vx, math.sin(off), math.cos(off)]
        return np.array([*own, c, s, self.turning, self.told, self.place[0] - self.begin[0]], np.float32)

    def is_success(self):
        return bool(abs(self.place[0] - self.begin[0]) > 3)

    def forward_speed(self):
        return math.cos(self.heading) * self.velocity[0] + math.sin(self.heading) * self.velocity[1]

    def reward(self):
        return 0.5 * self.forward_speed() - 0.05 * abs(self.turning)


class HovercraftAnyWay(Hovercraft):
    def forward_speed(self):
        return float(np.linalg.norm(self.velocity))


class HovercraftOnTheStreet(Hovercraft):
    """Told how fast to go along a street."""

    def pace(self):
        """Speed along the street [m/s]."""
        vx, vy = self.velocity
        return math.cos(self.street) * vx + math.sin(self.street) * vy

    def reward(self):
        return math.exp(-(((self.pace() - self.told) / 0.2) ** 2)) + 0.1 * math.cos(self.street - self.heading)


class HovercraftOffTheStreet(HovercraftOnTheStreet):
    def pace(self):
        """Speed along the street [m/s]."""
        vx, vy = self.velocity
        return math.sqrt(vx**2 + vy**2)


class HovercraftOfTerms(Hovercraft):
    """Its terms are in a dictionary."""

    def reward(self):
        street = np.array([math.cos(self.street), math.sin(self.street)])
        terms = {"toward": float(self.velocity @ street), "calm": -0.1 * self.turning**2}
        return sum(terms.values())


class HovercraftOfLengths(Hovercraft):
    def reward(self):
        terms = {"toward": float((self.velocity**2).sum() ** 0.5), "calm": -0.1 * self.turning**2}
        return sum(terms.values())


class HovercraftIsFast(Hovercraft):
    """It may go anywhere, as fast as it can."""

    def reward(self):
        speed = np.hypot(*self.velocity)
        return 0.5 * speed - 0.1 * self.turning**2


class Tricycle(Hovercraft):
    """It cannot slide: the length of its velocity is its speed ahead."""

    def move(self, action):
        super().move(action)
        self.velocity = (0.5 + 0.4 * action[0]) * np.array([math.cos(self.heading), math.sin(self.heading)])

    def reward(self):
        forward = np.linalg.norm(self.velocity)
        return 0.5 * forward - 0.1 * self.turning**2
