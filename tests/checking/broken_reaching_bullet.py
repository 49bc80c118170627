"""A sled in PyBullet pushes a cube to a spot. Its frame is moved and turned, and each reset builds the world again."""

import gymnasium as gym
import numpy as np
import pybullet as p
from gymnasium import spaces

BASE, YAW = np.array([0.2, -0.4]), 1.2


def rot(v, a):
    c, s = np.cos(a), np.sin(a)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


class Sled(gym.Env):
    """On two rails; its reward is one number."""

    metadata = {"render_modes": []}
    rlctl_ignore = {"RL611": "chance does not push it there", "RL904": "it builds its world in reset"}
    reach_weight = 2

    def __init__(self):
        self.c = p.connect(p.DIRECT)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Dict(
            {k: spaces.Box(-np.inf, np.inf, (2,), np.float32) for k in ("tool", "tool_cube", "cube_spot")}
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        c, r = self.c, self.np_random
        p.resetSimulation(physicsClientId=c)
        p.setGravity(0, 0, -9.81, physicsClientId=c)
        fl = p.createCollisionShape(p.GEOM_BOX, halfExtents=[2, 2, 0.05], physicsClientId=c)
        p.createMultiBody(0, fl, basePosition=[0, 0, -0.05], physicsClientId=c)
        b = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.04] * 3, physicsClientId=c)
        big = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.05] * 3, physicsClientId=c)
        tool, cube = r.uniform(-0.35, 0.35, (2, 2))
        while np.linalg.norm(tool - cube) < 0.2:
            tool = r.uniform(-0.35, 0.35, 2)
        self.spot = r.uniform(-0.5, 0.5, 2)
        while np.linalg.norm(self.spot - cube) < 0.15:
            self.spot = r.uniform(-0.5, 0.5, 2)
        links = {
            "linkMasses": [0.5, 1.0],
            "linkCollisionShapeIndices": [-1, b],
            "linkVisualShapeIndices": [-1, -1],
            "linkPositions": [[0, 0, 0.05], [0, 0, 0]],
            "linkOrientations": [[0, 0, 0, 1]] * 2,
            "linkInertialFramePositions": [[0, 0, 0]] * 2,
            "linkInertialFrameOrientations": [[0, 0, 0, 1]] * 2,
            "linkParentIndices": [0, 1],
            "linkJointTypes": [p.JOINT_PRISMATIC] * 2,
            "linkJointAxis": [[1, 0, 0], [0, 1, 0]],
        }
        self.robot = p.createMultiBody(0, -1, basePosition=[0, 0, 0], physicsClientId=c, **links)
        self.cube = p.createMultiBody(0.2, big, basePosition=[*cube, 0.05], physicsClientId=c)
        for j in (0, 1):
            p.resetJointState(self.robot, j, tool[j], physicsClientId=c)
        self.t = 0
        self.want = tool.copy()
        self.d, self.h = self._dist()
        return self._obs(), {}

    def _base(self, v):
        return rot(np.asarray(v)[:2] - BASE, -YAW)

    def _tool(self):
        return np.array([p.getJointState(self.robot, j, physicsClientId=self.c)[0] for j in (0, 1)])

    def _cube(self):
        return np.array(p.getBasePositionAndOrientation(self.cube, physicsClientId=self.c)[0][:2])

    def _cube_spot(self):
        return self._base(self.spot) - self._base(self._cube())

    def _dist(self):
        return float(np.linalg.norm(self._cube_spot())), float(np.linalg.norm(self._tool() - self._cube()))

    def _obs(self):
        t, k = self._base(self._tool()), self._base(self._cube())
        return {
            "tool": t.astype(np.float32),
            "tool_cube": (k - t).astype(np.float32),
            "cube_spot": self._cube_spot().astype(np.float32),
        }

    def step(self, a):
        if not np.isfinite(a).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(a, float), -1, 1)
        self.want = np.clip(self.want + 0.03 * rot(a, YAW), -0.7, 0.7)
        for j in (0, 1):
            p.setJointMotorControl2(self.robot, j, p.POSITION_CONTROL, self.want[j], force=60, physicsClientId=self.c)
        for _ in range(12):
            p.stepSimulation(physicsClientId=self.c)
        self.t += 1
        d, h = self._dist()
        r = 10 * (self.d - d) + self.reach_weight * (self.h - h) - 0.05 - 0.01 * float(a @ a)
        self.d, self.h = d, h
        ok = bool(np.linalg.norm(self._cube() - self.spot) < 0.05)
        if ok:
            r += 8.0
        return self._obs(), float(r), ok, self.t >= 150 and not ok, {"is_success": ok}

    def close(self):
        if self.c is not None:
            p.disconnect(self.c)
            self.c = None


class RL626SledTwoFrames(Sled):
    def _cube_spot(self):
        return self.spot - self._base(self._cube())


class RL622SledLeavesCube(Sled):
    reach_weight = -2
