"""Environments that waive rules, well and badly."""

import numpy as np
from broken_envs import Clean
from gymnasium import spaces


class Wide(Clean):
    rlctl_ignore = {"RL106": "the actions are Newtons, as the real motor has them"}

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-2.0, 2.0, (2,), np.float32)

    def move(self, action):
        super().move(action / 2)


class NoReason(Wide):
    rlctl_ignore = {"RL106": " "}


class NoSuchRule(Wide):
    rlctl_ignore = {"RL1006": "typing"}


class NoDictionary(Wide):
    rlctl_ignore = ("RL106",)
