"""Robots that observe a vector of the world next to others in the frame of the robot, with noise; and their twins."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Dinghy(gym.Env):
    """It sails to a mark; a dictionary, with noise, is its observation."""

    rlctl_ignore = {"RL609": "it has no goal"}

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (7,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.yaw = self.np_random.uniform(-np.pi, np.pi)
        self.wanted = self.yaw + self.np_random.uniform(-1, 1)
        self.pos, self.vel, self.turning = self.np_random.uniform(-1, 1, 2), np.zeros(2), 0.0
        self.mark = self.np_random.uniform(-2, 2, 2)
        self.steps = 0
        return self.observe(), {}

    def matrix(self):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s], [s, c]])

    def noise(self, size):
        return self.np_random.normal(0, 0.02, size)

    def step(self, action):
        action = np.clip(np.nan_to_num(action), -1, 1)
        self.vel = 0.9 * self.vel + 0.2 * self.matrix() @ action[:2]
        self.pos = self.pos + 0.1 * self.vel
        self.turning = 0.8 * self.turning + 0.3 * action[2]
        self.yaw += 0.1 * self.turning
        self.steps += 1
        return self.observe(), -float(np.linalg.norm(self.mark - self.pos)), False, self.steps >= 60, {}

    def velocity(self):
        return self.matrix().T @ self.vel

    def turned(self):
        error = self.wanted - self.yaw
        return [self.turning, np.sin(error), np.cos(error)]

    def observe(self):
        to_body = self.matrix().T
        seen = {
            "mark": to_body @ (self.mark - self.pos) + self.noise(2),
            "velocity": self.velocity() + self.noise(2),
            "turned": np.array(self.turned()) + self.noise(3),
        }
        return np.concatenate([np.asarray(value, np.float32) for value in seen.values()])


class RL129DinghyVelocity(Dinghy):
    def velocity(self):
        return self.vel


class RL129DinghyClipped(Dinghy):
    def velocity(self):
        return np.clip((self.vel + self.noise(2)) / 2.0, -3, 3)


class DinghyScaled(Dinghy):
    """Parts are scaled one after the other."""

    def observe(self):
        parts = {}
        parts["mark"] = (self.mark - self.pos) @ self.matrix()
        parts["velocity"] = self.velocity()
        parts["turned"] = self.turned()
        seen = []
        for name, part in parts.items():
            scaled = np.asarray(part, float) * {"mark": 0.5}.get(name, 1.0)
            seen.append(scaled + self.noise(len(scaled)))
        return np.hstack(seen).astype(np.float32)


class RL129DinghyScaled(DinghyScaled):
    def velocity(self):
        return self.vel


class DinghyZipped(Dinghy):
    """Elements and noise, pair by pair."""

    def turn(self, v):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * v[0] + s * v[1], c * v[1] - s * v[0]])

    def velocity(self):
        return self.turn(self.vel)

    def observe(self):
        x, y = self.turn(self.mark - self.pos)
        vx, vy = self.velocity()
        clean = [x, y, vx, vy, *self.turned()]
        return np.array([one + error for one, error in zip(clean, self.noise(7), strict=True)], np.float32)


class RL129DinghyZipped(DinghyZipped):
    def velocity(self):
        return self.vel
