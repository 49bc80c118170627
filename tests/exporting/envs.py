"""Small environments with every kind of observation and action; deterministic, 20 steps an episode."""

import gymnasium
import numpy as np
from gymnasium import spaces

VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 40, 3), np.uint8)
OBSERVATIONS = {
    "vector": VECTOR,
    "double": spaces.Box(-np.inf, np.inf, (3,), np.float64),
    "image": IMAGE,
    "image_first": spaces.Box(0, 255, (3, 36, 40), np.uint8),
    "discrete": spaces.Discrete(5),
    "multidiscrete": spaces.MultiDiscrete([5, 3]),
    "multibinary": spaces.MultiBinary(3),
    "dict": spaces.Dict(
        {"camera": IMAGE, "joints": VECTOR, "mode": spaces.Discrete(5), "switch": spaces.MultiBinary(2)}
    ),
    "taken": spaces.Dict({"action": VECTOR, "joints": VECTOR}),
    "parts": spaces.Dict({"joints": VECTOR, "mode": spaces.Discrete(5), "switch": spaces.MultiBinary(2)}),
}
ACTIONS = {
    "box": spaces.Box(np.array([-2.0, -0.5], np.float32), np.array([1.0, 3.0], np.float32)),
    "matrix": spaces.Box(-0.1, 0.1, (2, 3), np.float32),
    "double": spaces.Box(-0.1, 0.3, (2,), np.float64),
    "wide": spaces.Box(-1000.0, 1000.0, (2,), np.float32),
    "integer": spaces.Box(0, 5, (2,), np.int32),
    "discrete": spaces.Discrete(4),
    "multidiscrete": spaces.MultiDiscrete([2, 3, 4]),
    "multibinary": spaces.MultiBinary(3),
}


class Small(gymnasium.Env):
    """A point that actions push around; it is rewarded for its place, and `noise` moves it by chance nobody seeded.

    With a `factor` far above 1 a difference in the last bits of an action grows to another episode. With `keeps` an
    episode begins with the last push of the one before.
    """

    def __init__(self, observation="vector", action="box", noise=0.0, factor=0.0, keeps=False):
        self.observation_space = OBSERVATIONS[observation]
        self.action_space = ACTIONS[action]
        self.noise = noise
        self.factor = factor
        self.keeps = keeps
        self.push = np.zeros(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.normal(size=3) + (self.push if self.keeps else 0.0)
        self.steps = 0
        return self._observe(self.observation_space), {}

    def step(self, action):
        self.push = np.resize(np.asarray(action, np.float64), 3)
        before = np.sin(self.factor * self.place) if self.factor else self.place
        self.place = 0.9 * before + 0.1 * np.sin(self.push) + self.noise * np.random.default_rng().normal(size=3)
        self.steps += 1
        return self._observe(self.observation_space), float(self.place.sum()), False, self.steps == 20, {}

    def _observe(self, space):
        level = int(abs(self.place[0]) * 10)
        if isinstance(space, spaces.Dict):
            return {key: self._observe(part) for key, part in space.spaces.items()}
        if isinstance(space, spaces.Discrete):
            return level % int(space.n)
        if isinstance(space, spaces.MultiDiscrete):
            return np.array([level, level + 1]) % space.nvec
        if isinstance(space, spaces.MultiBinary):
            return (self.place[: space.n] > 0).astype(np.int8)
        if len(space.shape) == 3:
            ramp = np.arange(np.prod(space.shape)).reshape(space.shape)
            return ((ramp * (1 + level)) % 256).astype(np.uint8)
        return self.place.astype(space.dtype)
