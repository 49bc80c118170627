"""Plain environments in PyBullet."""

import math
from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
import pybullet as p
import pybullet_data
from gymnasium import spaces
from pybullet_utils.bullet_client import BulletClient

ARM = Path(__file__).with_name("arm.urdf")
TIP = 1  # link index
LOADED, HELD, PAINTED, REMOVED, STEPS = 3, 4, 5, 7, 10  # the steps in which something happens to the cube


class Workshop(gymnasium.Env):
    """An arm, and a cube that exists for a while and is held by a constraint. Every reset builds the world."""

    metadata = {"render_modes": []}
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def __init__(self, worlds: int = 1):
        self.worlds = worlds
        self.clients = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if not self.clients:  # many environments connect only now
            self.clients = [BulletClient(p.DIRECT) for _ in range(self.worlds)]
        for number, client in enumerate(self.clients):
            client.resetSimulation()
            client.setGravity(0, 0, -9.81)
            client.setAdditionalSearchPath(pybullet_data.getDataPath())
            client.loadURDF("plane.urdf")
            self.arm = client.loadURDF(str(ARM), [number, 0, 0], useFixedBase=True)
        self.bullet = self.clients[0]
        self.steps = 0
        return self._observe(), {}

    def _observe(self):
        # Without computeForwardKinematics: where the last substep began.
        return np.array(self.bullet.getLinkState(self.arm, TIP)[4])

    def step(self, action):
        self.steps += 1
        push = self.bullet.getLinkState(self.arm, TIP)[4]  # the same as after the last step
        for _ in range(4):
            self.bullet.setJointMotorControlArray(
                self.arm, [0, 1], p.VELOCITY_CONTROL, targetVelocities=(2 * action).tolist(), forces=[50, 50]
            )
            self.bullet.applyExternalForce(self.arm, TIP, [20 * push[0], 0, 5], [0, 0, 0], p.LINK_FRAME)
            self.bullet.stepSimulation()
        self._change_cube()
        return self._observe(), float(push[2]), False, self.steps >= STEPS, {}

    def _change_cube(self):
        bullet = self.bullet
        if self.steps == LOADED:
            box = bullet.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1])
            self.cube = bullet.createMultiBody(1.0, box, basePosition=[1, 0, 1])
        if self.steps == HELD:
            bullet.createConstraint(
                self.arm, TIP, self.cube, -1, p.JOINT_POINT2POINT, [0, 0, 0], [0, 0, 0.1], [0, 0, 0]
            )
        if self.steps == PAINTED:
            bullet.changeVisualShape(self.cube, -1, rgbaColor=[1, 0, 0, 1])
        if self.steps == REMOVED:
            bullet.removeBody(self.cube)
        tip = bullet.getLinkState(self.arm, TIP)[4]
        bullet.addUserDebugLine([0, 0, 0], tip, [0, 1, 0], replaceItemUniqueId=-1)

    def close(self):
        for client in self.clients:
            client.disconnect()
        self.clients = []


class Shared(Workshop):
    """All instances have one client, which stays connected."""

    connected: ClassVar[list] = []

    def __init__(self):
        self.worlds, self.clients = 1, self.connected

    def close(self):
        pass


class Crawler(gymnasium.Env):
    """A robot of an MJCF file, on ground of a height field, next to a body that is drawn as a mesh of arrays."""

    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def __init__(self, file: str = "mjcf/ant.xml"):
        self.file = file
        self.bullet = BulletClient(p.DIRECT)
        self.bullet.setAdditionalSearchPath(pybullet_data.getDataPath())

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.bullet.resetSimulation()
        heights = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
        hills = self.bullet.createCollisionShape(
            p.GEOM_HEIGHTFIELD, meshScale=[0.5, 0.5, 2], heightfieldData=heights, numHeightfieldRows=3,
            numHeightfieldColumns=2,
        )  # fmt: skip
        self.bullet.createMultiBody(0, hills)
        points, sides = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
        tent = self.bullet.createVisualShape(p.GEOM_MESH, vertices=points, indices=sides, meshScale=[2, 2, 2])
        self.bullet.createMultiBody(0, -1, tent)
        hidden = self.bullet.createVisualShape(p.GEOM_SPHERE, radius=0.3, rgbaColor=[1, 1, 1, 0])
        self.bullet.createMultiBody(0, -1, hidden)
        self.ant = self.bullet.loadMJCF(self.file)[0]
        return self._observe(), {}

    def _observe(self):
        return np.array(self.bullet.getBasePositionAndOrientation(self.ant)[0])

    def step(self, action):
        self.bullet.stepSimulation()
        return self._observe(), 0.0, False, False, {}

    def close(self):
        self.bullet.disconnect()


class Diverging(Workshop):
    """A free arm that is nowhere from the fifth step on, in which a constraint holds a cube to it."""

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        self.arm = self.bullet.loadURDF(str(ARM), [0, 0, 1])
        return observation, info

    def step(self, action):
        if self.steps == 4:
            self.bullet.resetBasePositionAndOrientation(self.arm, [math.nan] * 3, [math.nan] * 4)
        _, _, terminated, truncated, info = super().step(action)
        return np.zeros(3), 0.0, terminated, truncated, info


class Jelly(Crawler):
    """A cube that is soft."""

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        self.bullet.resetSimulation(p.RESET_USE_DEFORMABLE_WORLD)
        self.ant = self.bullet.loadURDF(str(ARM), useFixedBase=True)
        self.bullet.loadSoftBody("cube.obj", mass=1.0)
        return self._observe(), {}
