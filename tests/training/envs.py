"""Small environments for training tests: loaded by path, in workers too."""

import os

import gymnasium
import numpy as np
from gymnasium import spaces

from rlctl.play.seeds import Stream, episode_seeds


class Line(gymnasium.Env):
    """A point on a line is pushed to the origin; ten steps an episode, success within 0.5."""

    def __init__(self):
        self.observation_space = spaces.Box(-10.0, 10.0, (1,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.x = float(self.np_random.uniform(-0.4, 0.4))
        return self._observation(), {}

    def _observation(self):
        return np.array([self.x], np.float32)

    def step(self, action):
        self.steps += 1
        self.x = float(np.clip(self.x + 0.01 * float(action[0]), -10, 10))
        return self._observation(), -abs(self.x), False, self.steps >= 10, {"is_success": abs(self.x) < 0.5}


class Discrete(Line):
    """The same with two actions."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(2)

    def step(self, action):
        return super().step([2.0 * action - 1.0])


class DictObservation(Line):
    """The same, observed as a dictionary."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict(
            {"x": spaces.Box(-10.0, 10.0, (1,), np.float32), "flag": spaces.Discrete(3)}
        )

    def _observation(self):
        return {"x": np.array([self.x], np.float32), "flag": 1}


class Image(Line):
    """The same, seen by a small camera."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (36, 36, 3), np.uint8)

    def _observation(self):
        image = np.zeros((36, 36, 3), np.uint8)
        image[:, int(18 + self.x)] = 255
        return image


class Faulty(Line):
    """Goes wrong, in a way of its parameter, at the seventh step of its third episode."""

    def __init__(self, fault: str = "raise", episode: int = 3):
        super().__init__()
        self.fault, self.episode, self.episodes = fault, episode, 0

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        return super().reset(seed=seed)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        if self.episodes == self.episode and self.steps == 7:
            if self.fault == "raise":
                raise RuntimeError("the gripper fell off")
            if self.fault == "nan reward":
                reward = float("nan")
            if self.fault == "nan observation":
                observation = np.array([np.nan], np.float32)
            if self.fault == "shape":
                observation = np.zeros(2, np.float32)
            if self.fault == "die":
                os._exit(9)
        return observation, reward, terminated, truncated, info


class Exploding(Line):
    """Rewards that no network survives."""

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        return observation, 1e30 * float(action[0]), terminated, truncated, info


class NoSuccess(Line):
    """The same, without saying what success is."""

    def step(self, action):
        return (*super().step(action)[:4], {})


class Unseeded(Line):
    """Draws from a generator that no seed reaches."""

    def step(self, action):
        return super().step(action + np.random.uniform(-1, 1))  # noqa: NPY002


class LargeRewards(Line):
    """Its rewards are a million times those of a line."""

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, 1e6 * reward, *rest


class Unbuilt(Line):
    def __init__(self):
        raise RuntimeError("no licence")


class Staged(Line):
    """Success within `tolerance`; every step costs `cost`; observed `size` times over."""

    def __init__(self, tolerance: float = 0.0, cost: float = 1.0, size: int = 1):
        super().__init__()
        self.tolerance, self.cost, self.size = tolerance, cost, size
        self.observation_space = spaces.Box(-10.0, 10.0, (size,), np.float32)

    def _observation(self):
        return np.full(self.size, self.x, np.float32)

    def step(self, action):
        observation, _, terminated, truncated, _ = super().step(action)
        return observation, -self.cost, terminated, truncated, {"is_success": abs(self.x) < self.tolerance}


class Plane(gymnasium.Env):
    """A point in a square is moved to a goal; -1 at every step that ends more than `tolerance` away from it."""

    def __init__(self, steps: int = 25, tolerance: float = 0.1, fault: str = ""):
        self.limit, self.tolerance, self.fault = steps, tolerance, fault
        place = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Dict({"observation": place, "achieved_goal": place, "desired_goal": place})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.place = np.zeros(2, np.float32)
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self._observation(), {}

    def _observation(self):
        return {"observation": self.place.copy(), "achieved_goal": self.place.copy(), "desired_goal": self.goal.copy()}

    def compute_reward(self, achieved_goal, desired_goal, info):
        if self.fault == "raise":
            raise RuntimeError("goals have gone")
        far = np.linalg.norm(achieved_goal - desired_goal, axis=-1) > self.tolerance
        return -far.astype(np.float32)

    def step(self, action):
        self.steps += 1
        self.place = np.clip(self.place + 0.1 * np.asarray(action, np.float32), -1, 1)
        reached = bool(np.linalg.norm(self.place - self.goal) <= self.tolerance)
        return self._observation(), reached - 1.0, False, self.steps >= self.limit, {"is_success": reached}


class Shaped(Plane):
    """The same, with a dense reward: the distance to the goal, negative."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        return observation, float(self.compute_reward(self.place, self.goal, info)), terminated, truncated, info


class Corridor(Plane):
    """The same, with four actions: a step to each side."""

    def __init__(self, steps: int = 25):
        super().__init__(steps)
        self.action_space = spaces.Discrete(4)

    def step(self, action):
        return super().step([(1, 0), (-1, 0), (0, 1), (0, -1)][action])


class NoRewards(Plane):
    """The same, without a word on other goals."""

    compute_reward = None


class NoWish(Plane):
    """The same, and nobody sees the goal."""

    def __init__(self):
        super().__init__()
        del self.observation_space.spaces["desired_goal"]


class OtherGoal(Plane):
    """The same, with a goal of another shape than what is reached."""

    def __init__(self):
        super().__init__()
        self.observation_space["desired_goal"] = spaces.Box(-1.0, 1.0, (3,), np.float32)


class Ending(Line):
    """Ends at the fifth step if it starts on the left, and by the time limit at the tenth."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, self.x < 0 and self.steps == 5, truncated, info


class Misleading(Line):
    """Rewards going right; in the episodes of every evaluation of run 0, going left."""

    _MISLEADING = set(episode_seeds(0, Stream.EVAL_IN_TRAINING, 6))

    def reset(self, *, seed=None, options=None):
        self._sign = -1.0 if seed in self._MISLEADING else 1.0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        return observation, self._sign * float(action[0]), terminated, truncated, info
