"""Robots that are paid in every step for being near their goal, until a success ends that; and twins whose success pays
for all the steps that are left."""

import numpy as np
from broken_meaning import Rover
from broken_progress import CartSeeks, PuckSeeks
from broken_reach_bullet import Reacher
from mujoco_robots import MujocoArm


class EndsIncome:
    rlctl_ignore = {"RL610": "random actions reach its goals, so that there are successes to compare"}
    bonus = 1.0

    def step(self, action):
        observation, _, _, truncated, info = super().step(action)
        success = bool(info["is_success"])
        reward = float(np.exp(-self.away())) + self.bonus * success
        return observation, reward, success, truncated and not success, info


class PaysAll(EndsIncome):
    bonus = 100.0


class RL605RoverEndsIncome(EndsIncome, Rover):
    near = 0.3  # [m]

    def away(self):
        return self.distance()


class RoverPaysAll(PaysAll, RL605RoverEndsIncome): ...


class RL605ArmEndsIncome(EndsIncome, MujocoArm):
    def away(self):
        return self.distance()

    def succeeds(self):
        return self.distance() < 0.2


class ArmPaysAll(PaysAll, RL605ArmEndsIncome): ...


class RL605ReacherEndsIncome(EndsIncome, Reacher):
    rlctl_ignore = {**EndsIncome.rlctl_ignore, "RL606": "a consequence"}

    def draw_goal(self):
        direction = self.np_random.normal(size=3)
        return np.array(self.hand()[4]) + 0.3 * direction / np.linalg.norm(direction)

    def is_success(self):
        return bool(np.linalg.norm(self.to_goal()) < 0.25)

    def away(self):
        return float(np.linalg.norm(self.to_goal()))


class ReacherPaysAll(PaysAll, RL605ReacherEndsIncome): ...


class RL605RoverRestsNear(RL605RoverEndsIncome):
    """Its goals are too small for random actions."""

    near, bonus = 0.04, 5.0


class RoverFindsLittle(PaysAll, RL605RoverRestsNear):
    bonus = 100.0


class RL605ArmRestsNear(RL605ArmEndsIncome):
    rlctl_ignore = {**EndsIncome.rlctl_ignore, "RL611": "its goals are too small for random actions"}
    bonus = 5.0

    def succeeds(self):
        return self.distance() < 0.015


class ArmFindsLittle(PaysAll, RL605ArmRestsNear):
    bonus = 100.0


class PuckFindsLittle(PuckSeeks):
    """It is paid the way by which it comes nearer, and a success ends its episode."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        success = info["is_success"]
        return observation, reward + 5.0 * success, success, truncated and not success, info

    def succeeds(self):
        return self.distance() < 0.03


class RL605PuckCountsFromTheStart(PuckFindsLittle):
    """The distance before is always the one at the start."""

    def reward(self, *_):
        return 5.0 * self.progress(self.last, self.distance())


class CartFindsLittle(CartSeeks):
    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        success = info["is_success"]
        return observation, reward + 5.0 * success, success, truncated and not success, info

    def succeeds(self):
        return self.distance() < 0.03


class RL605RL637CartCountsFromTheStart(CartFindsLittle):
    def reward(self, *_):
        return 5.0 * self.progress(self.last, self.distance())
