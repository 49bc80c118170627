"""Environments that are slow, each in its own way, and others that are slow with good reason."""

import argparse
import contextlib
import functools
import time

import numpy as np
from broken_envs import Clean
from gymnasium import spaces

from rlctl.checking.experiments.speed import FIRST_SPEED_SEED
from rlctl_manipulation.reach import Reach

with contextlib.suppress(ModuleNotFoundError):  # whatever needs it is skipped without it
    import pybullet
    import pybullet_data
    from pybullet_utils.bullet_client import BulletClient


def work(seconds):
    """Be busy."""
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        sum(range(20_000))


class RL901SlowStep(Clean):
    """Slow only in the episodes in which time is measured, so that the test is not."""

    def move(self, action):
        if self.np_random_seed >= FIRST_SPEED_SEED:
            work(0.015)
        super().move(action)


class RL903Sleeps(Clean):
    """Keeps real time, for nobody."""

    def move(self, action):
        time.sleep(0.0003)
        super().move(action)


class SleepsInReset(Clean):
    def start(self):
        time.sleep(0.01)
        super().start()


class RL903Renders(Clean):
    """Draws at every step what nobody asked for."""

    def move(self, action):
        super().move(action)
        self.render()

    def render(self):
        picture = np.zeros((64, 64, 3), np.uint8)
        for _ in range(20):
            picture = np.roll(picture, 1, axis=0)
        return picture


class RendersNothing(RL903Renders):
    def render(self):
        return None


class RL903Sees(RL903Renders):
    """Its observation is the picture."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)

    def observe(self):
        return np.full((64, 64, 3), int(100 + 10 * self.position[0]), np.uint8)


class World(Clean):
    """A plane and a ball, loaded once, through a `BulletClient`."""

    def __init__(self):
        super().__init__(size=100.0)
        self.connect()
        self.load()

    def connect(self):
        self.bullet = BulletClient(pybullet.DIRECT)

    def load(self):
        self.bullet.setAdditionalSearchPath(pybullet_data.getDataPath())
        self.bullet.setGravity(0, 0, -9.81)
        self.bullet.loadURDF(
            "plane.urdf",
            basePosition=[float(each) for each in np.zeros(3)],
        )
        shape = self.bullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=0.1)
        self.ball = self.bullet.createMultiBody(1.0, shape, basePosition=[0, 0, 1.0])

    def start(self):
        super().start()
        self.bullet.resetBasePositionAndOrientation(self.ball, [*self.position, 1.0], [0, 0, 0, 1])
        self.bullet.resetBaseVelocity(self.ball, [0, 0, 0], [0, 0, 0])

    def move(self, action):
        self.bullet.resetBaseVelocity(self.ball, [float(action[0]), float(action[1]), 0.0])
        self.bullet.stepSimulation()
        place, _ = self.bullet.getBasePositionAndOrientation(self.ball)
        self.position = np.array(place[:2], np.float32)

    def close(self):
        if self.bullet._client >= 0:
            self.bullet.disconnect()


class RL904Reconnects(World):
    def start(self):
        self.close()
        self.connect()
        self.load()
        super().start()


class Rebuilds(World):
    """Loads a robot, which takes some milliseconds, at every reset."""

    def load(self):
        super().load()
        self.bullet.loadURDF("kuka_iiwa/model.urdf", useFixedBase=True)

    def start(self):
        self.bullet.resetSimulation()
        self.load()
        super().start()


class RL904ReadsFile(Clean):
    """Reads at every step what never changes."""

    def move(self, action):
        with open(argparse.__file__) as file:
            file.read()
        super().move(action)


class CameraAtEveryStep(World):
    def move(self, action):
        super().move(action)
        self.bullet.getCameraImage(
            64,
            min(64, 100),
            renderer=pybullet.ER_TINY_RENDERER,
        )


class KeepsPartials(World):
    """Fetches its functions once: what calls them cannot be seen, and nothing else must be blamed."""

    def __init__(self):
        super().__init__()
        self.advance = functools.partial(pybullet.stepSimulation, physicsClientId=self.bullet._client)

    def move(self, action):
        self.advance()
        Clean.move(self, action)


class ReloadingTask(Reach):
    """Says that its world must be loaded anew."""

    fast_reset = False
    episode_s = 0.5  # so that a busy machine does not make its steps the larger part
