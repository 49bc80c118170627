"""Robots that are moved by their own velocity, as the engine has done already, and twins that are moved on purpose; and
robots that measure their velocity over a step."""

import numpy as np
import pybullet as p
from broken_turned import Cart, CrawlerLooks, Flyer, Puck
from mujoco_robots import MujocoArm, MujocoHopper
from robots import Arm, Crawler, Pusher
from scipy.spatial.transform import Rotation


class Twice:
    """After the steps of the physics, positions in MuJoCo are advanced once more."""

    def move(self, action):
        super().move(action)
        self.data.qpos[-self.joints :] += 0.01 * self.data.qvel[-self.joints :]


class RL823ArmTwice(Twice, MujocoArm):
    pass


class RL823HopperTwice(Twice, MujocoHopper):
    pass


class RL823CartTwice(Twice, Cart):
    rlctl_ignore = {"RL306": "it begins always alike"}


class RL823FlyerTwice(Flyer):
    """Its base is advanced by hand before each step."""

    def move(self, action):
        self.data.qpos[:3] += 0.02 * self.data.qvel[:3]
        super().move(action)


class TwiceInBullet:
    """Joints in PyBullet are set to where their speed leads, and keep it."""

    def move(self, action):
        super().move(action)
        for joint in range(3):
            position, speed, *_ = p.getJointState(self.robot, joint, physicsClientId=self.client)
            p.resetJointState(self.robot, joint, position + speed / 30, speed, physicsClientId=self.client)


class RL823BulletArmTwice(TwiceInBullet, Arm):
    pass


class RL823PusherTwice(TwiceInBullet, Pusher):
    pass


class RL823CrawlerTwice(Crawler):
    """Its base is advanced by hand after each step."""

    def move(self, action):
        super().move(action)
        place, turn = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        velocity, turning = p.getBaseVelocity(self.robot, physicsClientId=self.client)
        place = np.add(place, np.divide(velocity, 30)).tolist()
        p.resetBasePositionAndOrientation(self.robot, place, turn, physicsClientId=self.client)
        p.resetBaseVelocity(self.robot, velocity, turning, physicsClientId=self.client)


class RL823PusherWithABelt(Pusher):
    """A belt without a mass is put where it should be before each step, and has no velocity."""

    def load(self):
        super().load()
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1] * 3, physicsClientId=self.client)
        self.belt = p.createMultiBody(0.0, shape, basePosition=[2, 0, 0.1], physicsClientId=self.client)

    def move(self, action):
        place, turn = p.getBasePositionAndOrientation(self.belt, physicsClientId=self.client)
        place = [place[0], place[1] + 0.2 / 30, place[2]]
        p.resetBasePositionAndOrientation(self.belt, place, turn, physicsClientId=self.client)
        super().move(action)


class RL823CartIsPushed(Cart):
    """Now and then its velocity changes, and it is set back to the middle where it has left."""

    def move(self, action):
        super().move(action)
        if self.steps % 5 == 0:
            self.data.qvel[:2] += 0.3
        if abs(self.data.qpos[0]) > 0.05:
            self.data.qpos[0] = 0.0


class Measures:
    """It sees its velocity, from its place one step before, in its own frame."""

    last = None

    def start(self):
        super().start()
        self.last = None

    def measured(self, place, turn):
        place = np.array(place)
        way = np.zeros(3) if self.last is None else place - self.last
        self.last = place
        return turn.inv().apply(way) / self.time()


class PerPhysicsStep:
    def time(self):
        return self.physics_step


class MeasuresInMujoco(Measures):
    physics_step = 0.005

    def time(self):
        return self.physics_step * self.frames

    def observe(self):
        velocity = self.measured(self.data.qpos[:3], self.turn())
        return np.concatenate([self.turn().as_matrix()[0], velocity, self.data.qvel[3:6]])


class FlyerMeasures(MeasuresInMujoco, Flyer): ...


class FlyerMeasuresPerPhysicsStep(PerPhysicsStep, FlyerMeasures): ...


class CartMeasures(MeasuresInMujoco, Cart): ...


class CartMeasuresPerPhysicsStep(PerPhysicsStep, CartMeasures): ...


class MeasuresInBullet(Measures):
    physics_step, steps_of_physics = 1 / 120, 4

    def time(self):
        return self.physics_step * self.steps_of_physics

    def size(self):
        return 6

    def observe(self):
        place, quaternion = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        turn = Rotation.from_quat(quaternion)
        return np.concatenate([turn.as_matrix()[0], self.measured(place, turn)]).astype(np.float32)


class PuckMeasures(MeasuresInBullet, Puck):
    physics_step, steps_of_physics = 1 / 240, 8


class PuckMeasuresPerPhysicsStep(PerPhysicsStep, PuckMeasures): ...


class CrawlerMeasures(MeasuresInBullet, CrawlerLooks): ...


class CrawlerMeasuresPerPhysicsStep(PerPhysicsStep, CrawlerMeasures): ...


class PusherMeasures(Measures, Pusher):
    """It sees how fast its cube slides, in the world's frame."""

    physics_step = 1 / 120

    def time(self):
        return 4 * self.physics_step

    def size(self):
        return super().size() + 3

    def observe(self):
        place, _ = p.getBasePositionAndOrientation(self.cube, physicsClientId=self.client)
        velocity = self.measured(place, Rotation.identity())
        return np.concatenate([super().observe(), velocity]).astype(np.float32)


class PusherMeasuresPerPhysicsStep(PerPhysicsStep, PusherMeasures): ...
