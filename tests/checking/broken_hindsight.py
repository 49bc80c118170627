"""Robots with goals that hindsight replaces, in NumPy, MuJoCo and PyBullet."""

import numpy as np
from broken_meaning import Rover
from broken_reach_bullet import Reacher
from gymnasium import spaces
from mujoco_robots import MujocoArm


class Hindsight:
    """Mixed into a robot with a goal and an `achieved()` place; pays the distance, and counts near places."""

    near, sparse = 0.2, False  # [m]

    def __init__(self):
        super().__init__()
        goal = spaces.Box(-np.inf, np.inf, self.goal.shape, np.float32)
        rest = spaces.Box(-np.inf, np.inf, self.observation_space.shape, np.float32)
        self.observation_space = spaces.Dict(observation=rest, achieved_goal=goal, desired_goal=goal)

    def reset(self, **settings):
        observation, info = super().reset(**settings)
        return self.with_goals(observation), info

    def step(self, action):
        observation, _, _, truncated, info = super().step(action)
        observation = self.with_goals(observation)
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
        return observation, float(reward), False, truncated, info

    def with_goals(self, observation):
        achieved, desired = np.float32(self.achieved()), np.float32(self.goal)
        return {"observation": observation, "achieved_goal": achieved, "desired_goal": desired}

    def compute_reward(self, achieved_goal, desired_goal, info):
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -np.asarray(distance > self.near, float) if self.sparse else -distance


class OwnGoal:
    """Pays the distance to the present goal, whatever goal it is asked for."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return super().compute_reward(achieved_goal, np.float32(self.goal), info)


class RL614RoverSeeks(Hindsight, Rover):
    def achieved(self):
        return self.place


class RL614RoverOwnGoal(OwnGoal, RL614RoverSeeks): ...


class RL614ArmSparse(Hindsight, MujocoArm):
    """Hardly ever near its goal: all that is paid is -1."""

    sparse = True

    def achieved(self):
        return self.tip().copy()


class RL614ArmOwnGoal(OwnGoal, RL614ArmSparse): ...


class RL614ReacherSeeks(Hindsight, Reacher):
    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "chance hardly finds its goals"}
    goal = np.zeros(3)

    def achieved(self):
        return np.array(self.hand()[4])


class RL614ReacherOwnGoal(OwnGoal, RL614ReacherSeeks): ...
