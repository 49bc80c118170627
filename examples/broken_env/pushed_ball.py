"""A ball that is pushed to a goal: an environment as it is often written, with eight mistakes in fifty lines.

rlctl check-env examples/broken_env/pushed_ball.py:PushedBall
"""

import gymnasium
import numpy as np
import pybullet as p
from gymnasium import spaces

GOAL = np.zeros(2)
MAX_STEPS = 60


class PushedBall(gymnasium.Env):
    """The observation is the ball's position and velocity; the action is a push."""

    metadata = {"render.modes": ["human"]}

    def __init__(self):
        self.observation_space = spaces.Box(-10.0, 10.0, (4,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        p.connect(p.DIRECT)

    def reset(self, *, seed=None, options=None):
        p.resetSimulation()
        p.setGravity(0, 0, -9.81)
        p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE))
        place = np.random.uniform(-0.5, 0.5, 2)  # noqa: NPY002
        ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.05)
        self.ball = p.createMultiBody(0.2, ball, basePosition=[*place, 0.05])
        self.steps = 0
        return self._observation(), {}

    def step(self, action):
        action = np.clip(action, -1.0, 1.0)
        p.resetBaseVelocity(self.ball, [float(action[0]), float(action[1]), 0.0])
        for _ in range(10):
            p.stepSimulation()
        self.steps += 1
        observation = self._observation()
        distance = np.linalg.norm(observation[:2] - GOAL)
        reward = float(-distance)
        if distance < 0.05:
            reward += 10.0
        terminated = (distance < 0.02) | (self.steps >= MAX_STEPS)
        return observation, reward, terminated, False, {}

    def _observation(self):
        place, _ = p.getBasePositionAndOrientation(self.ball)
        velocity, _ = p.getBaseVelocity(self.ball)
        return np.array([*place[:2], *velocity[:2]], np.float32)
