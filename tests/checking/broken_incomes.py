"""Robots that are paid in every step for being near their goal, until a success ends that; and twins whose success pays
for all the steps that are left."""

import numpy as np
from broken_meaning import Rover
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
    def draw_goal(self):
        direction = self.np_random.normal(size=3)
        return np.array(self.hand()[4]) + 0.3 * direction / np.linalg.norm(direction)

    def is_success(self):
        return bool(np.linalg.norm(self.to_goal()) < 0.25)

    def away(self):
        return float(np.linalg.norm(self.to_goal()))


class ReacherPaysAll(PaysAll, RL605ReacherEndsIncome): ...
