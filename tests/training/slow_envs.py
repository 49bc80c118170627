"""An environment whose steps take long."""

import time

import gymnasium
import numpy as np
from gymnasium import spaces


class Slow(gymnasium.Env):
    """Walks for 20 steps; a step takes `step_s`, a reset `reset_s`."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, step_s=0.05, reset_s=0.0):
        self.step_s, self.reset_s = step_s, reset_s

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        time.sleep(self.reset_s)
        self.place, self.steps = self.np_random.normal(), 0
        return np.array([self.place], np.float32), {}

    def step(self, action):
        time.sleep(self.step_s)
        self.steps += 1
        self.place += 0.1 * float(action[0])
        return np.array([self.place], np.float32), -abs(self.place), False, self.steps >= 20, {}
