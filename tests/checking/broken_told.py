"""Robots in NumPy, PyBullet and MuJoCo that tell in a dictionary of their own what they are paid for, next to robots
whose terms cost nothing, or pay."""

import numpy as np
from broken_meaning import Rover
from broken_reach_bullet import Reacher
from mujoco_robots import MujocoArm


class Tells:
    """Its `info` has the weighted terms."""

    where, time = "terms", -0.05

    def reset(self, *, seed=None, options=None):
        self.last = np.zeros(self.action_space.shape)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        terms = {
            "distance": -self.away(),
            "effort": -0.02 * self.effort(np.asarray(action, float)),
            "change": -0.02 * self.measure_change(action, self.last),
            "time": self.time,
        }
        self.last = np.array(action)
        return observation, float(sum(terms.values())), terminated, truncated, {**info, self.where: terms}

    def effort(self, action):
        return np.square(action).sum()

    def measure_change(self, action, last):
        return np.square(action - last).sum()


class RoverTells(Tells, Rover):
    def away(self):
        return self.distance()


class ArmTells(Tells, MujocoArm):
    where = "components"

    def away(self):
        return self.distance()


class ReacherTells(Tells, Reacher):
    where = "parts"

    def away(self):
        return float(np.linalg.norm(self.to_goal()))


class RL621RoverPaidForTime(RoverTells):
    time = 0.05


class RL621ArmPaidForTime(ArmTells):
    time = 0.05


class RL621ReacherPaidForTime(ReacherTells):
    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "chance does not get there"}

    time = 0.02


class Signed:
    def effort(self, action):
        return action.sum()


class RL630RoverTellsSigns(Signed, RoverTells): ...


class RL630ArmTellsSigns(Signed, ArmTells): ...


class RL630ReacherTellsSigns(Signed, ReacherTells):
    rlctl_ignore = {"RL611": "a consequence", "RL619": "it hardly moves along y, where goals are, too"}


class Forgets:
    """It compares an action with itself."""

    def measure_change(self, action, last):
        last = np.array(action)
        return np.square(action - last).sum()


class RL620RoverForgets(Forgets, RoverTells): ...


class RL620ArmForgets(Forgets, ArmTells): ...


class RL620ReacherForgets(Forgets, ReacherTells):
    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "chance does not get there"}
