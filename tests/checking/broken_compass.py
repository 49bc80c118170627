"""A kayak whose heading is that of a compass, with a vector that one line turns the other way than the others."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Kayak(gymnasium.Env):
    """It goes to a buoy in a stream; its heading is that of a compass, from the north to the right."""

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.drift, self.strokes = self.np_random.uniform(-1, 1, 2), np.zeros(2), np.zeros(2)
        self.buoy = self.place + self.np_random.uniform(-1.5, 1.5, 2)
        self.stream = self.np_random.uniform(-0.2, 0.2, 2)
        self.heading = self.np_random.uniform(-3, 3)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))
        success = self.distance() < 0.1
        return self.observe(), -self.distance(), success, self.steps >= 60, {"is_success": success}

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


class KayakTurnsItsSpeedBack(Kayak):
    def own_speed(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.array([[c, s], [-s, c]]) @ self.drift
