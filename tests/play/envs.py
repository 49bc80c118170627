"""Environments that behave, and environments that do not; loaded by path in workers."""

import ctypes
import os
import subprocess
import sys
import time
from dataclasses import dataclass

import gymnasium
import numpy as np
from gymnasium import spaces

from rlctl.task import Box, Task


class Walk(gymnasium.Env):
    """A random walk of 5 to 14 steps, all chance from the seed; what `fault` names happens at step 3."""

    def __init__(self, fault="", faulty_seed=7, size=2):
        self.fault, self.faulty_seed = fault, faulty_seed
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (size,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode_seed = seed
        self.length, self.steps = int(self.np_random.integers(5, 15)), 0
        self.place = self.np_random.normal(size=self.observation_space.shape)
        return self.place.astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 3 and self.episode_seed == self.faulty_seed:
            self.fail()
        self.place = self.place + 0.1 * np.asarray(action) + 0.01 * self.np_random.normal(size=self.place.shape)
        observation, reward = self.place.astype(np.float32), -float(np.abs(self.place).sum())
        if self.steps == 3 and self.episode_seed == self.faulty_seed:
            observation = {"nan observation": np.full_like(observation, np.nan), "shape": np.zeros(5)}.get(
                self.fault, observation
            )
            reward = float("inf") if self.fault == "inf reward" else reward
        done = self.steps >= self.length
        return observation, reward, done, False, {"is_success": self.length > 9, "distance": abs(self.place[0])}

    def fail(self):
        if self.fault == "raise":
            raise RuntimeError("the gripper fell off")
        if self.fault == "segfault":
            ctypes.string_at(0)
        if self.fault == "exit":
            sys.exit("done here")
        if self.fault == "_exit":
            os._exit(4)
        if self.fault == "hang":
            time.sleep(600)
        if self.fault == "print":
            print("hello from the environment")
            os.system("echo hello from its child >&2")


class Long(Walk):
    """An episode of `length` steps without a time limit; it observes how many are done."""

    def __init__(self, length=1000):
        super().__init__()
        self.steps_of_an_episode = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.full(2, self.steps, np.float32), 0.0, self.steps == self.steps_of_an_episode, False, {}


class FailsToStart(Walk):
    def __init__(self):
        raise RuntimeError("no licence for this robot")


class FailsToReset(Walk):
    def reset(self, *, seed=None, options=None):
        raise RuntimeError("cannot find home")


class Holder(Walk):
    """Leaves a process of its own behind, which keeps the output open."""

    def __init__(self):
        super().__init__()
        self.child = subprocess.Popen(["sleep", "600"])

    def close(self):
        self.child.kill()


class Spaces(gymnasium.Env):
    """Three steps in a space of each kind; the reward is what the action was worth."""

    def __init__(self, kind):
        self.kind = kind
        self.observation_space = {
            "dict": spaces.Dict({"z": spaces.Box(-1, 1, (2,), np.float32), "a": spaces.Discrete(5)}),
            "image": spaces.Box(0, 255, (4, 6, 3), np.uint8),
            "discrete": spaces.Discrete(7),
            "binary": spaces.MultiBinary(3),
        }[kind]
        self.action_space = {
            "dict": spaces.Discrete(4),
            "image": spaces.MultiDiscrete([3, 2]),
            "discrete": spaces.Discrete(2),
            "binary": spaces.MultiBinary(4),
        }[kind]

    def observe(self):
        return {
            "dict": lambda: {"z": np.full(2, 0.1 * self.steps, np.float32), "a": self.steps},
            "image": lambda: np.full((4, 6, 3), 50 * self.steps, np.uint8),
            "discrete": lambda: 2 * self.steps,
            "binary": lambda: np.array([self.steps % 2, 0, 1], np.int8),
        }[self.kind]()

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action), repr(action)
        self.steps += 1
        return self.observe(), float(np.sum(action)), False, self.steps == 3, {}


class Goals(Walk):
    """Says what goals are worth, minus their distance times `scale`; what `fault` names happens instead."""

    def __init__(self, fault="", scale=1.0):
        super().__init__()
        self.goals_fault, self.scale = fault, scale

    def compute_reward(self, achieved_goal, desired_goal, info):
        assert info == [{}] * len(achieved_goal)
        rewards = -self.scale * np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        if self.goals_fault == "raise":
            raise RuntimeError("the goal has gone")
        if self.goals_fault == "nan":
            rewards[2] = np.nan
        if self.goals_fault == "exit":
            sys.exit("done here")
        if self.goals_fault == "_exit":
            os._exit(4)
        if self.goals_fault == "hang":
            time.sleep(600)
        return {
            "column": rewards[:, None],
            "number": rewards[0],
            "text": rewards.astype(str),
            "list": list(rewards),
        }.get(self.goals_fault, rewards)


@dataclass
class Counting(Task):
    """A task without physics: a number is counted."""

    goal: float = 3.0

    control_dt, episode_s = 0.1, 0.4
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    reward_weights = {"count": 1.0, "fixed": 0.5}

    def build(self, sim):
        self.count = 0.0

    def reset(self, rng):
        self.count = float(rng.uniform())

    def act(self, action):
        self.count += float(action[0])

    def observe(self):
        return {"count": np.array([self.count])}

    def rewards(self, action):
        return {"fixed": 2.0, "count": self.count}


@dataclass
class Sunk(Counting):
    """A cube that begins 2 cm inside the floor."""

    reward_weights = {"height": 1.0}

    def build(self, sim):
        super().build(sim)
        sim.load("floor", "plane.urdf", fixed=True)
        self.cube = sim.load("cube", "cube_small.urdf", position=(0.0, 0.0, 0.005))  # its half edge is 0.025 m

    def observe(self):
        return {"position": self.cube.base_position}

    def rewards(self, action):
        return {"height": float(self.cube.base_position[2])}
