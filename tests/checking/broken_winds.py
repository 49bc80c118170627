"""Vehicles that observe wind or current with gusts and noise, and the way along a line of any direction: nothing shows
their heading; and their twins."""

import math

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Kayak(gym.Env):
    """It paddles along a line over a river, whose current has eddies."""

    rlctl_ignore = {"RL609": "it has no goal"}
    limit = 80

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.uniform
        self.line = draw(-np.pi, np.pi)
        self.yaw = self.line + draw(-0.3, 0.3)
        self.pier = draw(-20, 20, 2)
        self.pos = self.pier + draw(-2, 2, 2)
        self.speed, self.turning = draw(0.0, 0.5), 0.0
        towards = draw(-np.pi, np.pi)
        self.river = draw(0.2, 0.9) * np.array([np.cos(towards), np.sin(towards)])
        self.eddy = np.zeros(2)
        self.steps = 0
        return self.observe(), {}

    def seen_current(self, current):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * current[0] + s * current[1], c * current[1] - s * current[0]])

    def observe(self):
        noise = self.np_random.normal(0, 0.01, 8)
        way, error = self.pos - self.pier, self.yaw - self.line
        c, s = np.cos(self.line), np.sin(self.line)
        along, aside = c * way[0] + s * way[1], c * way[1] - s * way[0]
        current = self.seen_current(self.river + self.eddy)
        seen = [along / 5, aside, np.sin(error), np.cos(error), self.speed, self.turning, *current]
        return (np.array(seen) + noise).astype(np.float32)

    def step(self, action):
        action = np.clip(np.nan_to_num(action), -1, 1)
        self.speed += 0.1 * (1.5 * action[0] - self.speed)
        self.turning += 0.3 * (action[1] - self.turning)
        self.yaw += 0.1 * self.turning
        ahead = np.array([np.cos(self.yaw), np.sin(self.yaw)])
        self.pos = self.pos + 0.1 * (self.speed * ahead + self.river + self.eddy)
        self.eddy = 0.8 * self.eddy + 0.03 * self.np_random.normal(0, 1, 2)
        self.steps += 1
        way = self.pos - self.pier
        aside = np.cos(self.line) * way[1] - np.sin(self.line) * way[0]
        return self.observe(), float(self.speed - abs(aside)), False, self.steps >= self.limit, {}


class RL129KayakCurrent(Kayak):
    def seen_current(self, current):
        return current


class Blimp(gym.Env):
    """It drifts with the wind to a mast; its numbers are attributes of their own."""

    rlctl_ignore = {"RL609": "it has no goal"}

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict({"mast": box, "wind": box, "rates": box})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.uniform
        self.heading = draw(0.0, 2 * math.pi)
        self.mast = draw(-30, 30, 2)
        self.place = draw(-30, 30, 2)
        self.rate, self.steps = 0.0, 0
        self.wind_x, self.wind_y = draw(-6, 6, 2)
        return self.observe(), {}

    def turn(self, x, y):
        c, s = math.cos(self.heading), math.sin(self.heading)
        return c * x + s * y, c * y - s * x

    def measure_wind(self):
        gust = self.np_random.normal(0.0, 0.25, 2)
        return self.turn(self.wind_x + gust[0], self.wind_y + gust[1])

    def observe(self):
        way = self.turn(*(self.mast - self.place))
        seen = {"mast": np.array(way) / 20, "wind": np.array(self.measure_wind()) / 5, "rates": [self.rate, 1.0]}
        seen["rates"][1] = self.steps / 60
        return {name: np.array(value, np.float32) for name, value in seen.items()}

    def step(self, action):
        action = np.clip(np.nan_to_num(action), -1, 1)
        self.rate += 0.2 * (action[2] - self.rate)
        self.heading = (self.heading + 0.2 * self.rate) % (2 * math.pi)
        c, s = math.cos(self.heading), math.sin(self.heading)
        push = 4.0 * np.array([c * action[0] - s * action[1], s * action[0] + c * action[1]])
        self.place = self.place + 0.2 * (push + 0.5 * np.array([self.wind_x, self.wind_y]))
        self.steps += 1
        return self.observe(), -float(np.linalg.norm(self.mast - self.place)) / 20, False, self.steps >= 60, {}


class RL129BlimpWind(Blimp):
    def measure_wind(self):
        gust = self.np_random.normal(0.0, 0.25, 2)
        return self.wind_x + gust[0], self.wind_y + gust[1]
