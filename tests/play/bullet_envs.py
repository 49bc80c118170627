"""A ball that falls for 20 steps, whatever the action, in PyBullet environments that name their client in other ways.

The return is the same in every episode of a world of its own: the sum of the ball's heights.
"""

import gymnasium
import numpy as np
import pybullet as p
from gymnasium import spaces
from pybullet_utils.bullet_client import BulletClient


class Ball(gymnasium.Env):
    """Nothing is wrong with it: every call has the client."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self):
        self.client = p.connect(p.DIRECT)
        self.own = {"physicsClientId": self.client}
        p.setAdditionalSearchPath("/tmp")  # changes no world
        self.load()

    def load(self):
        p.resetSimulation(**self.own)
        p.setGravity(0, 0, -10, **self.own)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1, **self.own)
        self.ball = p.createMultiBody(1.0, shape, basePosition=[0, 0, 2.0], **self.own)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.load()
        return self.observe(), {}

    def step(self, action):
        p.stepSimulation(**self.own)
        self.steps += 1
        return self.observe(), float(self.observe()[0]), False, self.steps >= 20, {}

    def observe(self):
        return np.array([p.getBasePositionAndOrientation(self.ball, **self.own)[0][2]], np.float32)

    def close(self):
        p.disconnect(**self.own)


class Forgets(Ball):
    """Every call leaves the client out."""

    def __init__(self):
        p.connect(p.DIRECT)
        self.own = {}
        self.load()


class ForgetsToStep(Ball):
    """Only the physics step leaves the client out."""

    def step(self, action):
        p.stepSimulation()
        self.steps += 1
        return self.observe(), float(self.observe()[0]), False, self.steps >= 20, {}


class Wrapped(Ball):
    """A BulletClient adds the client."""

    def __init__(self):
        self.bullet, self.own = BulletClient(p.DIRECT), {}
        self.load()

    def load(self):
        self.bullet.resetSimulation()
        self.bullet.setGravity(0, 0, -10)
        shape = self.bullet.createCollisionShape(p.GEOM_SPHERE, radius=0.1)
        self.ball = self.bullet.createMultiBody(1.0, shape, basePosition=[0, 0, 2.0])

    def step(self, action):
        self.bullet.stepSimulation()
        self.steps += 1
        return self.observe(), float(self.observe()[0]), False, self.steps >= 20, {}

    def observe(self):
        return np.array([self.bullet.getBasePositionAndOrientation(self.ball)[0][2]], np.float32)

    def close(self):
        self.bullet.disconnect()
