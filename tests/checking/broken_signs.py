"""Robots whose cost is a sum with signs, next to twins that square it."""

import numpy as np
from broken_meaning import Drone, Rover
from broken_turned import Flyer


class RoverSaves(Rover):
    def reward(self, action):
        reward = -self.distance()
        reward -= 0.05 * np.sum(action**2)
        return reward


class RL630RoverReverses(RoverSaves):
    def reward(self, action):
        reward = -self.distance()
        reward -= 0.05 * np.sum(action)
        return reward


class DroneThrottles(Drone):
    """Its thrust is never negative; nothing is wrong with it."""

    weight = 0.1

    def reward(self, action):
        throttle = (action + 1.0) / 2.0
        reward = np.exp(-self.distance())
        reward -= self.weight * throttle.sum()
        return reward


class RL630DroneBrakes(DroneThrottles):
    def reward(self, action):
        action = np.clip(action, -1.0, 1.0)
        reward = np.exp(-self.distance())
        reward += -self.weight * float(np.mean(action))
        return reward


class FlyerTells(Flyer):
    """It tells what it is paid for."""

    last = np.zeros(3)

    def move(self, action):
        self.last = action.copy()
        super().move(action)

    def terms(self):
        return {"ahead": self.ahead(), "effort": self.effort()}

    def effort(self):
        return -0.1 * float(np.abs(self.last).sum())

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        terms = self.terms()
        return observation, sum(terms.values()), terminated, truncated, {**info, "reward_terms": terms}


class RL630FlyerPaysReverse(FlyerTells):
    def effort(self):
        return -0.1 * float(self.last.sum())
