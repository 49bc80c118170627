"""`Clean`, and environments that differ from it in one mistake each."""

import ctypes
import os
import sys
import time

import gymnasium
import numpy as np
from gymnasium import spaces

LIMIT = 50  # [steps]


class Clean(gymnasium.Env):
    """A point in a square is pushed to its middle; nothing is wrong with it."""

    metadata = {"render_modes": []}

    def __init__(self, size: float = 5.0):
        self.size = size
        self.observation_space = spaces.Box(-size, size, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.start()
        return self.observe(), {}

    def start(self):
        self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def step(self, action):
        if not np.all(np.isfinite(action)):
            raise ValueError(f"action {action} is not finite")
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0))
        return self.observe(), self.reward(), self.is_terminated(), self.is_truncated(), self.info()

    def move(self, action):
        self.position = np.clip(self.position + 0.1 * action, -self.size, self.size)

    def observe(self):
        return self.position.copy()

    def reward(self):
        return -float(np.linalg.norm(self.position))

    def is_terminated(self):
        return False

    def is_truncated(self):
        return self.steps >= LIMIT

    def info(self):
        return {"is_success": bool(np.linalg.norm(self.position) < 0.1)}


class CleanDict(Clean):
    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict({"position": self.observation_space, "step": spaces.Discrete(LIMIT + 1)})

    def observe(self):
        return {"position": self.position.copy(), "step": self.steps}


class RaisingConstructor(Clean):
    def __init__(self):
        raise FileNotFoundError("robot.urdf")


class NeedsArgument(Clean):
    def __init__(self, gain):
        super().__init__()
        self.gain = gain


class RL003NoEnvironment:
    pass


class RL003OldGym:
    """As written for the old `gym` package."""

    observation_space = spaces.Box(-5, 5, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self):
        self.steps = 0
        return np.zeros(2, np.float32)

    def step(self, action):
        self.steps += 1
        return np.array([self.steps, self.steps**2], np.float32) / 400, 0.0, self.steps % 20 == 0, {}


class RL004ExitsWhenBuilt(Clean):
    def __init__(self):
        os._exit(7)


class RL101WrongShape(Clean):
    def observe(self):
        return np.zeros(3, np.float32)


class RL101MissingKey(CleanDict):
    def observe(self):
        return {"position": self.position.copy()}


class RL102Float64(Clean):
    def observe(self):
        return self.position.astype(np.float64)


class RL103OutOfRange(Clean):
    """Late in an episode only, where no library's checker looks."""

    def observe(self):
        return self.position + np.float32(7.0 * (self.steps == 30))


class RL103OutOfRangeAtReset(Clean):
    def observe(self):
        return self.position + np.float32(7.0 * (self.steps == 0))


class RL103OftenOutOfRange(Clean):
    def observe(self):
        return self.position + np.float32(7.0 * (self.steps % 5 == 3))


class RL103LastOutOfRange(Clean):
    """Outside only when an episode has just ended."""

    def observe(self):
        return self.position + np.float32(7.0 * (self.steps == LIMIT))


class RL103Rounding(Clean):
    def observe(self):
        rounded = np.nextafter(np.float32(self.size), np.float32(np.inf))
        return np.array([rounded if self.steps == 20 else 0.0, self.position[1]], np.float32)


class RL103OftenSlightlyOutOfRange(Clean):
    """As a joint with soft limits that is pushed against its stop."""

    def observe(self):
        pushed = 1.01 * self.size if self.steps % 5 == 3 else 0.0  # half a percent of -size..size
        return np.array([pushed, self.position[1]], np.float32)


class RL104NanObservation(Clean):
    def observe(self):
        return self.position * np.float32("nan" if self.steps == 11 else 1)


class RL104Diverges(Clean):
    """Its reward follows from the place, which is not finite."""

    def move(self, action):
        super().move(action)
        self.position = self.position * np.float32("nan" if self.steps == 11 else 1)


class RL105ReusedMemory(Clean):
    def start(self):
        super().start()
        self.buffer = getattr(self, "buffer", np.zeros(2, np.float32))

    def observe(self):
        self.buffer[:] = self.position
        return self.buffer


class RL106UnboundedActions(Clean):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)


class RL106WideActions(Clean):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-2.0, 2.0, (2,), np.float32)


class RL201FourValues(Clean):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated or truncated, info


class RL202NoSeed(Clean):
    def reset(self):
        return Clean.reset(self)


class PromisesPictures(RL202NoSeed):
    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None):
        super().__init__()


class SeedsItself(gymnasium.Wrapper):
    """It needs no seed of what it wraps."""

    def reset(self, *, seed=None, options=None):
        self.unwrapped.np_random, _ = gymnasium.utils.seeding.np_random(seed)
        return self.env.reset()


def no_seed_in_a_wrapper(render_mode=None):
    return gymnasium.wrappers.TimeLimit(PromisesPictures(render_mode), 50)


def seed_of_a_wrapper():
    return SeedsItself(RL202NoSeed())


class RL203NoOptions(Clean):
    def reset(self, *, seed=None):
        return Clean.reset(self, seed=seed)


class RL204NumpyBool(Clean):
    def is_terminated(self):
        return np.linalg.norm(self.position) < 0


class RL204ArrayReward(Clean):
    def reward(self):
        return self.position[:1]


class RL204Float32Reward(Clean):
    def reward(self):
        return self.position[0]


class RL204NoneInfo(Clean):
    def info(self):
        return None


class RL204SuccessIsADistance(Clean):
    def info(self):
        return {"is_success": max(0.0, 0.1 - float(np.linalg.norm(self.position)))}


class RL207Raises(Clean):
    def move(self, action):
        if self.steps == 7:
            raise RuntimeError("joint 3 is gone")
        super().move(action)


class RL207Exits(Clean):
    def move(self, action):
        if self.steps == 7:
            sys.exit(0)
        super().move(action)


class RL208Segfaults(Clean):
    def move(self, action):
        if self.steps == 7:
            ctypes.string_at(0)
        super().move(action)


class RL209Hangs(Clean):
    def move(self, action):
        if self.steps == 7:
            time.sleep(1e6)
        super().move(action)


class HangsAtOnce(Clean):
    def move(self, action):
        time.sleep(1e6)


class RL211Prints(Clean):
    def move(self, action):
        print("moving", action)
        super().move(action)


class RL501TimeLimitTerminates(Clean):
    def is_terminated(self):
        return self.steps >= LIMIT

    def is_truncated(self):
        return False


class RL502BothFlags(Clean):
    def is_terminated(self):
        return self.steps >= LIMIT


class RL503Endless(Clean):
    def is_truncated(self):
        return False


class RL504EndsAtOnce(Clean):
    def is_terminated(self):
        return True


class RL504EndsAtStepTwo(Clean):
    def is_truncated(self):
        return self.steps >= 2


class RL601NanReward(Clean):
    def reward(self):
        return float("nan") if self.steps == 13 else 0.0


NUMBER = 3
