"""A kayak whose heading is that of a compass, with a vector that one line turns the other way than the others."""

import numpy as np
from robots import Robot


class Kayak(Robot):
    """It goes to a buoy in a stream; its heading is that of a compass, from the north to the right."""

    def size(self):
        return len(self.observe())

    def __init__(self):
        self.place = self.buoy = self.drift = self.stream = self.strokes = np.zeros(2)
        self.heading = 0.0
        super().__init__()

    def start(self):
        self.place, self.drift, self.strokes = self.np_random.uniform(-1, 1, 2), np.zeros(2), np.zeros(2)
        self.buoy = self.place + self.np_random.uniform(-1.5, 1.5, 2)
        self.stream = self.np_random.uniform(-0.2, 0.2, 2)
        self.heading = self.np_random.uniform(-3, 3)

    def move(self, action):
        self.strokes = self.strokes + 0.4 * (action - self.strokes)
        self.heading += 0.2 * (self.strokes[0] - self.strokes[1])
        self.drift = self.strokes.sum() * np.array([np.sin(self.heading), np.cos(self.heading)]) + self.stream
        self.place = self.place + 0.1 * self.drift

    def inside(self, vector):
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])

    def own_speed(self):
        return self.inside(self.drift)

    def observe(self):
        shown = [self.inside(self.buoy - self.place), self.own_speed(), self.strokes]
        return np.concatenate([*shown, [np.sin(self.heading), np.cos(self.heading)]]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm(self.buoy - self.place))

    def is_success(self):
        return self.distance() < 0.1

    def reward(self):
        return -self.distance()


class RL124KayakTurnsItsSpeedBack(Kayak):
    def own_speed(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.array([[c, s], [-s, c]]) @ self.drift
