"""Environments that keep what they take or share spaces."""

import contextlib
import os
import threading

import numpy as np
from broken_envs import Clean
from broken_repeats import OwnWorld
from gymnasium import spaces

with contextlib.suppress(ModuleNotFoundError):  # whatever needs it is skipped without it
    import pybullet


class Reconnects(OwnWorld):
    """A new client on every reset; the old one is never disconnected."""

    def start(self):
        self.client = pybullet.connect(pybullet.DIRECT)
        super().start()


class ReconnectsProperly(OwnWorld):
    """The old client is disconnected: nothing leaks."""

    def start(self):
        self.close()
        self.client = pybullet.connect(pybullet.DIRECT)
        super().start()


class RL405LeavesBodies(OwnWorld):
    """Takes the ball away, and forgets the marker."""

    ball = -1

    def start(self):
        Clean.start(self)
        own = {"physicsClientId": self.client}
        pybullet.setGravity(0, 0, -10, **own)
        if self.ball >= 0:
            pybullet.removeBody(self.ball, **own)
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1, **own)
        self.ball = pybullet.createMultiBody(1.0, shape, basePosition=[*self.position, 1.0], **own)
        pybullet.createMultiBody(0.0, -1, -1, **own)


class RL405KeepsFiles(Clean):
    def __init__(self):
        super().__init__()
        self.files = []

    def start(self):
        super().start()
        self.files.append(open(os.devnull))  # noqa: SIM115

    def close(self):
        while self.files:
            self.files.pop().close()


class RL405KeepsThreads(Clean):
    def __init__(self):
        super().__init__()
        self.end = threading.Event()
        self.threads = []

    def start(self):
        super().start()
        self.threads.append(threading.Thread(target=self.end.wait, daemon=True))
        self.threads[-1].start()

    def close(self):
        self.end.set()


class RL405KeepsMemory(Clean):
    def __init__(self):
        super().__init__()
        self.kept = []

    def start(self):
        super().start()
        self.kept.append(np.ones(50_000))


class RL405Caches(RL405KeepsMemory):
    """Keeps what it made in the first resets only."""

    def start(self):
        super().start()
        del self.kept[20:]


class RL404ClassSpaces(Clean):
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self):
        super().__init__()
        del self.action_space


class RL404ClassObservations(Clean):
    observation_space = spaces.Box(-5.0, 5.0, (2,), np.float32)

    def __init__(self):
        super().__init__()
        del self.observation_space
