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


class RL614RoverParks(RL614RoverSeeks):
    """Its goal has a heading, too."""

    rlctl_ignore = {"RL611": "its success is that of the place"}

    def draw_goal(self):
        self.parked = self.np_random.uniform(-3, 3)
        return super().draw_goal()

    def __init__(self):
        super().__init__()
        goal = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.observation_space = spaces.Dict(
            observation=self.observation_space["observation"], achieved_goal=goal, desired_goal=goal
        )

    def with_goals(self, observation):
        achieved = [*self.place, np.cos(self.heading), np.sin(self.heading)]
        desired = [*self.goal, np.cos(self.parked), np.sin(self.parked)]
        return {
            "observation": observation,
            "achieved_goal": np.float32(achieved),
            "desired_goal": np.float32(desired),
        }

    def compute_reward(self, achieved_goal, desired_goal, info):
        distance = np.linalg.norm((achieved_goal - desired_goal)[..., :2], axis=-1)
        return -distance - 0.3 * (1 - self.compare(achieved_goal[..., 2:], desired_goal[..., 2:]))

    def compare(self, one, two):
        return (one * two).sum(axis=-1)


class RL614RoverParksMirrored(RL614RoverParks):
    def compare(self, one, two):
        return one[..., 0] * two[..., 0] - one[..., 1] * two[..., 1]


class RoverParksStraight(RL614RoverParks):
    """It is paid more where its heading is right to 15 degrees."""

    tolerance = np.deg2rad(15)

    def compute_reward(self, achieved_goal, desired_goal, info):
        reward = super().compute_reward(achieved_goal, desired_goal, info)
        return reward + 0.5 * (self.compare(achieved_goal[..., 2:], desired_goal[..., 2:]) > self.least_cosine())

    def least_cosine(self):
        return np.cos(self.tolerance)


class RL126RoverParksInDegrees(RoverParksStraight):
    tolerance = 15.0


class RL126RoverParksWithinANumber(RoverParksStraight):
    def least_cosine(self):
        return np.cos(15)
