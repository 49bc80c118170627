"""Environments with one mistake each in what their observation holds."""

import numpy as np
from broken_envs import LIMIT, Clean
from broken_repeats import RL306FixedStart
from gymnasium import spaces


class Wide(Clean):
    """Observes four numbers, all of them different ones: nothing is wrong with it."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(-1e3, 1e3, (4,), np.float32)

    def observe(self):
        x, y = self.position
        return np.array([x, y, self.third(x, y), x * y], np.float32)

    def third(self, x, y):
        return x + y * y


class RL110ConstantElement(Wide):
    def third(self, x, y):
        return 0.25


class RL110ConstantCounter(Clean):
    """A counter that never counts, beside a space with a single value, which could not change."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict(
            {"position": self.observation_space, "step": spaces.Discrete(LIMIT + 1), "one": spaces.Discrete(1)}
        )

    def observe(self):
        return {"position": self.position.copy(), "step": self.count(), "one": 0}

    def count(self):
        return 0


class RL110Counter(RL110ConstantCounter):
    def count(self):
        return self.steps


class RL110ConstantSpeed(Clean):
    """A measurement that is an array of its own, and never updated."""

    def __init__(self):
        super().__init__()
        speed = spaces.Box(-100, 100, (2,), np.float32)
        self.observation_space = spaces.Dict({"position": self.observation_space, "speed": speed})

    def observe(self):
        return {"position": self.position.copy(), "speed": self.speed()}

    def speed(self):
        return np.zeros(2, np.float32)


class RL110Speed(RL110ConstantSpeed):
    def speed(self):
        return self.position * np.float32(0.5)


class SomeFlags(Clean):
    """Flags of which one is hardly ever set: nothing is wrong with it."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict({"position": self.observation_space, "flags": spaces.MultiBinary(2)})

    def observe(self):
        return {"position": self.position.copy(), "flags": np.array([self.position[0] > 0, 0], np.int8)}


class RL114HiddenGoal(RL306FixedStart):
    """The goal is drawn at reset, and not observed."""

    def start(self):
        super().start()
        self.goal = self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def reward(self):
        return -float(np.linalg.norm(self.position - self.goal))

    def info(self):
        return {"is_success": self.reward() > -0.1}


class RL114HiddenGoalNoisyStart(RL114HiddenGoal):
    """The same, from a start that is drawn too, but not far from the same place."""

    def start(self):
        super().start()
        self.position += self.np_random.uniform(-0.02, 0.02, 2).astype(np.float32)


class Bandit(RL114HiddenGoal):
    """What the arms pay is hidden, and there is nothing to observe: nothing is wrong with it."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 1, (1,), np.float32)

    def observe(self):
        return np.zeros(1, np.float32)


class RL114SeenGoal(RL114HiddenGoal):
    """The goal is observed: nothing is wrong with it."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(-5.0, 5.0, (4,), np.float32)

    def observe(self):
        return np.concatenate([self.position, self.goal])


class RL114NoisyReward(RL306FixedStart):
    """Chance in each reward, not in the episode: nothing is hidden."""

    def reward(self):
        return super().reward() + float(self.np_random.normal(0.0, 0.5))


class ShownChance(RL306FixedStart):
    """Chance in each step, which the next observation shows."""

    def move(self, action):
        super().move(action + self.np_random.normal(0.0, 3.0, 2).astype(np.float32))
