"""`Cart`, a small PyBullet world without a mistake, and worlds that differ from it in one mistake each."""

from pathlib import Path

import numpy as np
import pybullet as p
from broken_envs import Clean
from gymnasium import spaces
from pybullet_utils.bullet_client import BulletClient

CART = str(Path(__file__).parent / "cart.urdf")
SHOULDER = 0
STEPS = 30
STANDING = 0.051  # [m], height of the base when the cart stands


class Cart(Clean):
    """A box on the floor is pushed to the middle and raises its arm; nothing is wrong with it."""

    rlctl_ignore = {"RL904": "loads anew at every reset, so that each is exactly the same"}
    fixed = False
    height = STANDING
    model, flags = CART, 0

    def __init__(self):
        super().__init__(size=100.0)
        self.observation_space = spaces.Box(-100.0, 100.0, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1 if self.fixed else 3,), np.float32)
        self.client = p.connect(p.DIRECT)

    def start(self):
        super().start()
        c = self.client
        p.resetSimulation(physicsClientId=c)
        p.setPhysicsEngineParameter(numSubSteps=4, deterministicOverlappingPairs=1, physicsClientId=c)
        p.setTimeStep(1 / 60, physicsClientId=c)
        p.setGravity(0, 0, -9.81, physicsClientId=c)
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[50, 50, 0.5], physicsClientId=c)
        self.floor = p.createMultiBody(0.0, shape, basePosition=[0, 0, -0.5], physicsClientId=c)
        place = [*self.position.tolist(), self.height]
        self.cart = p.loadURDF(self.model, place, useFixedBase=self.fixed, flags=self.flags, physicsClientId=c)
        self.vary()
        self.read()

    def vary(self):
        """Change what this episode is about."""

    def move(self, action):
        c = self.client
        if not self.fixed:
            self.push([30 * float(action[1]), 30 * float(action[2]), 0.0])
        speed = 3 * float(action[0])
        p.setJointMotorControl2(
            self.cart, SHOULDER, p.VELOCITY_CONTROL, targetVelocity=speed, force=2.0, physicsClientId=c
        )
        p.stepSimulation(physicsClientId=c)
        self.read()

    def push(self, force):
        place, _ = p.getBasePositionAndOrientation(self.cart, physicsClientId=self.client)
        p.applyExternalForce(self.cart, -1, force, place, p.WORLD_FRAME, physicsClientId=self.client)

    def read(self):
        place, _ = p.getBasePositionAndOrientation(self.cart, physicsClientId=self.client)
        self.position = np.clip(place[:2], -50, 50).astype(np.float32)
        self.angle = p.getJointState(self.cart, SHOULDER, physicsClientId=self.client)[0]

    def observe(self):
        return np.array([*self.position, np.clip(self.angle, -50, 50)], np.float32)

    def reward(self):
        return -abs(self.angle - 0.3) - (0 if self.fixed else float(np.linalg.norm(self.position)))

    def is_truncated(self):
        return self.steps >= STEPS

    def info(self):
        is_near = self.fixed or np.linalg.norm(self.position) < 0.5
        return {"is_success": bool(is_near and abs(self.angle - 0.3) < 0.1)}

    def close(self):
        if self.client >= 0:
            p.disconnect(physicsClientId=self.client)
        self.client = -1


class FixedCart(Cart):
    """Its base is part of the world; nothing is wrong with it."""

    fixed = True


class RL801NoGravity(Cart):
    rlctl_ignore = {**Cart.rlctl_ignore, "RL123": "a consequence"}

    def vary(self):
        p.setGravity(0, 0, 0, physicsClientId=self.client)


class RL801Flat(FixedCart):
    """Gravity is off, but nothing could fall: the arm turns about an upright axis."""

    def vary(self):
        upright = p.getQuaternionFromEuler([np.pi / 2, 0, 0])
        place = [*self.position.tolist(), 1.0]
        p.resetBasePositionAndOrientation(self.cart, place, upright, physicsClientId=self.client)
        p.setGravity(0, 0, 0, physicsClientId=self.client)


class RL803InTheFloor(Cart):
    """A block is set back into the floor at every step."""

    def vary(self):
        c = self.client
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1], physicsClientId=c)
        self.block = p.createMultiBody(1.0, shape, basePosition=[3, 3, 0.1], physicsClientId=c)

    def move(self, action):
        place, turn = [3, 3, 0.05], [0, 0, 0, 1]
        p.resetBasePositionAndOrientation(self.block, place, turn, physicsClientId=self.client)
        super().move(action)


class RL804BeyondLimits(Cart):
    def move(self, action):
        super().move(action)
        self.angle = 1.8 * float(action[0])
        p.resetJointState(self.cart, SHOULDER, self.angle, physicsClientId=self.client)


class RL804TurnsWithoutEnd(RL804BeyondLimits):
    """Its joint is continuous: the <limit> of its model means nothing."""

    model = CART.replace("cart.urdf", "cart_with_a_wheel.urdf")


class RL805Explodes(Cart):
    """A ball beside the cart is driven by a force without a bound."""

    def vary(self):
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1, physicsClientId=self.client)
        self.ball = p.createMultiBody(1.0, shape, basePosition=[5, 5, 0.1], physicsClientId=self.client)

    def move(self, action):
        place, _ = p.getBasePositionAndOrientation(self.ball, physicsClientId=self.client)
        force = [1e6 * float(each) for each in action]
        p.applyExternalForce(self.ball, -1, force, place, p.WORLD_FRAME, physicsClientId=self.client)
        super().move(action)


class RL807StartsInTheFloor(Cart):
    height = -0.02


class RL813LongPhysicsSteps(Cart):
    rlctl_ignore = {**Cart.rlctl_ignore, "RL123": "a consequence"}

    def vary(self):
        p.setTimeStep(1 / 48, physicsClientId=self.client)
        p.setPhysicsEngineParameter(numSubSteps=1, physicsClientId=self.client)


class ForgetsClient(Cart):
    def read(self):
        p.getNumBodies()
        super().read()


class OverridesForgetful(ForgetsClient):
    """What forgets the client is overridden, and not called; nothing is wrong with it."""

    read = Cart.read


class ThroughBulletClient(Clean):
    """All calls go through an object that adds the client; nothing is wrong with it."""

    rlctl_ignore = Cart.rlctl_ignore

    def __init__(self):
        super().__init__(size=100.0)
        self.p = BulletClient(p.DIRECT)

    def start(self):
        super().start()
        self.p.resetSimulation()
        self.p.setGravity(0, 0, -10)
        shape = self.p.createCollisionShape(self.p.GEOM_SPHERE, radius=0.1)
        self.ball = self.p.createMultiBody(1.0, shape, basePosition=[*self.position, 1.0])

    def move(self, action):
        p = self.p
        p.resetBaseVelocity(self.ball, [float(action[0]), float(action[1]), 0.0])
        p.stepSimulation()
        self.position = np.array(p.getBasePositionAndOrientation(self.ball)[0][:2], np.float32)

    def close(self):
        if self.p is not None:
            self.p.disconnect()
        self.p = None
