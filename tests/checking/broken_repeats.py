"""Environments that do not repeat, and instances that disturb each other."""

import collections
import contextlib
import random
import time

import numpy as np
from broken_envs import LIMIT, Clean
from gymnasium.envs.registration import EnvSpec

with contextlib.suppress(ModuleNotFoundError):  # whatever needs it is skipped without it
    import pybullet


class RL301RL309GlobalRandom(Clean):
    def start(self):
        self.position = np.random.uniform(-1, 1, 2).astype(np.float32)  # noqa: NPY002


class RaisesInStep(Clean):
    """Its steps fail; its reset is right."""

    def move(self, action):
        raise TypeError("no goal was set")


class SamplesTheStart(RaisesInStep):
    def start(self):
        self.position = self.observation_space.sample()


class RL302NoisyStep(Clean):
    def move(self, action):
        super().move(action + np.float32(0.001 * random.randint(0, 9)))


class NoisyByItsOwnGenerator(Clean):
    def __init__(self):
        super().__init__()
        self.own = np.random.default_rng()

    def move(self, action):
        super().move(action + np.float32(0.001 * self.own.standard_normal()))


class RL303LeakyReset(Clean):
    """Keeps the wind of an episode that did not come to its end."""

    wind = np.zeros(2, np.float32)

    def start(self):
        super().start()
        self.wind = self.wind if getattr(self, "unfinished", False) else np.zeros(2, np.float32)
        self.unfinished = True

    def move(self, action):
        self.wind = (self.wind + 0.01 * action).astype(np.float32)
        super().move(self.wind)
        self.unfinished = self.steps < LIMIT


class OldActions(Clean):
    """Keeps the last actions over a reset, and knows when the reset was."""

    def __init__(self):
        super().__init__()
        self.actions = collections.deque([np.zeros(2, np.float32)] * 5, maxlen=5)

    def start(self):
        super().start()
        self.a_time = time.time()
        self.position += 0.1 * self.actions[0]

    def move(self, action):
        self.actions.append(action)
        super().move(action)


class RL301OldActionsAsRegistered(OldActions):
    """Its registration calls chance what reset keeps."""

    spec = EnvSpec("OldActions-v0", nondeterministic=True)


class FirstEpisodeDiffers(Clean):
    """Its first episode pays more; the action that it keeps over a reset has no effect."""

    was_played, kept = False, 0.0

    def start(self):
        super().start()
        self.bonus = 0.0 if self.was_played else 1.0
        self.was_played = True

    def move(self, action):
        self.kept = float(action[0])
        super().move(action)

    def reward(self):
        return super().reward() + self.bonus


class KeptChance(Clean):
    """Starts where chance in the steps of the episode before left it."""

    offset = 0.0

    def start(self):
        super().start()
        self.position += np.float32(self.offset)

    def move(self, action):
        self.offset = random.random()
        super().move(action)


class RL304ClassCounter(Clean):
    count = 0

    def __init__(self):
        super().__init__()
        type(self).count += 1
        self.bias = 0.1 * type(self).count

    def start(self):
        super().start()
        self.position += np.float32(self.bias)


class RL305HashOrder(Clean):
    def start(self):
        super().start()
        self.position += np.float32(0.1 * next(iter({"left": 0, "right": 1, "up": 2, "down": 3}.keys())).__len__())
        self.position += np.float32(0.01 * (hash("goal") % 7))


class RL306FixedStart(Clean):
    def start(self):
        self.position = np.array([0.5, -0.3], np.float32)


class FixedStartNoise(RL306FixedStart):
    """A fixed start, with chance in the steps: nothing is wrong with it."""

    def move(self, action):
        super().move(action + self.np_random.uniform(-0.1, 0.1, 2).astype(np.float32))


class RL308UnseededLater(Clean):
    """Draws from a new generator at every reset, seeded or not."""

    def start(self):
        own = self.np_random if self.steps_seeded else np.random.default_rng()
        self.position = own.uniform(-1, 1, 2).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        self.steps_seeded = seed is not None
        return super().reset(seed=seed)


class RL301Residue(Clean):
    """Keeps a trace of what was before, far below what matters, like a simulation that is not reset in full."""

    trace = np.float32(0.0)

    def start(self):
        super().start()
        self.position += self.trace
        self.trace += np.float32(1e-6)


class RL401RL808SharedWorld(Clean):
    """PyBullet without physicsClientId, as most tutorials have it."""

    def __init__(self):
        super().__init__(size=100.0)
        self.client = pybullet.connect(pybullet.DIRECT)

    def start(self):
        super().start()
        pybullet.resetSimulation()
        pybullet.setGravity(0, 0, -10)
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1)
        self.ball = pybullet.createMultiBody(1.0, shape, basePosition=[*self.position, 1.0])

    def move(self, action):
        pybullet.resetBaseVelocity(self.ball, [float(action[0]), float(action[1]), 0.0])
        pybullet.stepSimulation()
        place, _ = pybullet.getBasePositionAndOrientation(self.ball)
        self.position = np.array(place[:2], np.float32)

    def close(self):
        if self.client >= 0:
            pybullet.disconnect(self.client)
        self.client = -1


class SharedWorldThatDraws(RL401RL808SharedWorld):
    """What it draws from NumPy's generator changes nothing."""

    def move(self, action):
        super().move(action * (1 + 0.0 * np.random.rand()))  # noqa: NPY002


class OwnWorld(RL401RL808SharedWorld):
    """The same with physicsClientId everywhere: nothing is wrong with it."""

    def start(self):
        Clean.start(self)
        own = {"physicsClientId": self.client}
        pybullet.resetSimulation(**own)
        pybullet.setGravity(0, 0, -10, **own)
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1, **own)
        self.ball = pybullet.createMultiBody(1.0, shape, basePosition=[*self.position, 1.0], **own)

    def move(self, action):
        own = {"physicsClientId": self.client}
        pybullet.resetBaseVelocity(self.ball, [float(action[0]), float(action[1]), 0.0], **own)
        pybullet.stepSimulation(**own)
        place, _ = pybullet.getBasePositionAndOrientation(self.ball, **own)
        self.position = np.array(place[:2], np.float32)


class RL402CloseBreaks(Clean):
    """The last thing that `close` ends is needed by all."""

    device = {"open": 0}

    def __init__(self):
        super().__init__()
        self.device["open"] = 1

    def move(self, action):
        if not self.device["open"]:
            raise RuntimeError("device is closed")
        super().move(action)

    def close(self):
        self.device["open"] = 0


class RL403OnlyOne(Clean):
    taken = False

    def __init__(self):
        if RL403OnlyOne.taken:
            raise OSError("port 5000 is in use")
        RL403OnlyOne.taken = True
        super().__init__()

    def close(self):
        pass


class NothingHappens(Clean):
    """No number changes, and an episode ends by its time only."""

    def observe(self):
        return np.zeros(2, np.float32)

    def reward(self):
        return -1.0

    def is_terminated(self):
        return super().is_truncated()

    def is_truncated(self):
        return False

    def info(self):
        return {"is_success": False, "reward_terms": {"effort": -1.0}}


class NothingHappensSlowly(NothingHappens):
    def observe(self):
        time.sleep(0.002)
        return super().observe()


class RL301StartsElsewhere(Clean):
    """It draws until it starts in the quarter opposite to where it was: how often, follows from the episode before."""

    def start(self):
        before = getattr(self, "position", None)
        super().start()
        while before is not None and (self.position * before > 0).any():
            self.position = self.np_random.uniform(-1, 1, 2).astype(np.float32)
