"""Environments with goals, whose rewards hindsight computes again."""

import os

import numpy as np
from broken_envs import Clean
from gymnasium import spaces


class Goal(Clean):
    """The point has to go to a place that is drawn: nothing is wrong with it."""

    def __init__(self):
        super().__init__()
        place = self.observation_space
        self.observation_space = spaces.Dict(observation=place, achieved_goal=place, desired_goal=place)

    def start(self):
        super().start()
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def observe(self):
        return {
            "observation": self.position.copy(),
            "achieved_goal": self.position.copy(),
            "desired_goal": self.goal.copy(),
        }

    def compute_reward(self, achieved_goal, desired_goal, info):
        """Of one goal, or of as many as there are rows."""
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)

    def reward(self):
        return float(self.compute_reward(self.position, self.goal, {}))

    def info(self):
        return {"is_success": self.reward() > -0.25}


class RL614OtherReward(Goal):
    """Learns from another reward than what hindsight computes."""

    def reward(self):
        return super().reward() - 0.5

    def info(self):
        return {"is_success": self.reward() > -0.75}


class EndsInComputeReward(Goal):
    """Ends the process where it is asked for rewards."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        os._exit(9)

    def reward(self):
        return -float(np.linalg.norm(self.position - self.goal))


class RL614OneByOne(Goal):
    """Cannot compute the rewards of many goals at once."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -float(np.linalg.norm(achieved_goal - desired_goal))


class RL614NumberlessReward(Goal):
    def compute_reward(self, achieved_goal, desired_goal, info):
        return "far"

    def reward(self):
        return Clean.reward(self)

    def info(self):
        return Clean.info(self)


class RL614NanComputed(EndsInComputeReward):
    """Computes NaN where the environment pays a number."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.full(len(achieved_goal), np.nan)


class NoReward(Goal):
    """Pays None."""

    def reward(self):
        return None

    def info(self):
        return {}


class LosesItsGoal(Goal):
    """Leaves the goal out after a few steps."""

    def observe(self):
        observation = super().observe()
        if self.steps > 3:
            del observation["desired_goal"]
        return observation


class RL614NestedGoal(Goal):
    """Its goals are dictionaries, which hindsight experience replay cannot take."""

    def __init__(self):
        super().__init__()
        place = spaces.Dict(place=self.observation_space["observation"])
        self.observation_space = spaces.Dict(observation=place["place"], achieved_goal=place, desired_goal=place)

    def observe(self):
        goals = {name: {"place": value} for name, value in super().observe().items() if name != "observation"}
        return {"observation": self.position.copy(), **goals}


class RL614RoundedReward(Goal):
    """Differs by rounding to float32: nothing is wrong with it."""

    def reward(self):
        return float(np.float32(super().reward()))
