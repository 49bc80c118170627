"""Robots that see a goal in their own frame and are paid for coming nearer, next to twins that are paid for going away.
Others pay for success, or take something for it."""

import numpy as np
import pybullet as p
from broken_reach_bullet import Reacher
from broken_turned import Cart, Flyer, Puck
from mujoco_robots import MujocoArm, MujocoHopper
from robots import Boat
from scipy.spatial.transform import Rotation


class Seeks:
    """It is drawn a place on the ground, and is paid the way by which it comes nearer. Mixed into a robot that has
    `place()`, shape (2,), and `yaw()`."""

    def start(self):
        super().start()
        self.goal = np.asarray(self.place()) + self.np_random.uniform(-1.0, 1.0, 2)
        self.last = self.distance()

    goal, last = np.ones(2), 0.0

    def distance(self):
        return float(np.linalg.norm(self.goal - self.place()))

    def seen(self):
        """The way to the goal: ahead, and to the left."""
        x, y = self.goal - self.place()
        cosine, sine = np.cos(self.yaw()), np.sin(self.yaw())
        return np.array([cosine * x + sine * y, cosine * y - sine * x])

    def observe(self):
        return np.concatenate([super().observe(), self.seen()]).astype(np.float32)

    def progress(self, before, after):
        return before - after

    def reward(self, *_):
        before, self.last = self.last, self.distance()
        return 5.0 * self.progress(before, self.last)

    def succeeds(self):
        return self.distance() < 0.15

    def info(self, _):
        return {"is_success": self.succeeds()}

    def place(self):
        return self.data.qpos[:2]


class GoesAway:
    def progress(self, before, after):
        return after - before


class InBullet:
    """Reads its base from PyBullet."""

    def size(self):
        return super().size() + 2

    def place(self):
        return np.array(p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)[0][:2])

    def yaw(self):
        _, quaternion = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        return p.getEulerFromQuaternion(quaternion)[2]


class TurnsBack:
    """The way to the goal is turned by the yaw, and not back by it."""

    def seen(self):
        x, y = self.goal - self.place()
        cosine, sine = np.cos(self.yaw()), np.sin(self.yaw())
        return np.array([cosine * x - sine * y, cosine * y + sine * x])


class FlyerSeeks(Seeks, Flyer):
    rlctl_ignore = {"RL110": "its height does not change"}


class RL125FlyerTurnsBack(TurnsBack, FlyerSeeks): ...


class RL125CartTurnsBack(Seeks, Cart):
    def seen(self):
        x, y = self.goal - self.place()
        cosine, sine = np.cos(self.yaw()), np.sin(self.yaw())
        return np.array([cosine * x - sine * y, cosine * y + sine * x])


class RL622FlyerGoesAway(GoesAway, FlyerSeeks): ...


class CartSeeks(Seeks, Cart): ...


class RL622CartGoesAway(GoesAway, CartSeeks): ...


class HopperSeeks(Seeks, MujocoHopper):
    def yaw(self):
        return self.attitude().as_euler("xyz")[2]


class RL125HopperTurnsBack(TurnsBack, HopperSeeks): ...


class PuckSeeks(InBullet, Seeks, Puck): ...


class RL125PuckTurnsBack(InBullet, TurnsBack, Seeks, Puck): ...


class RL622PuckGoesAway(GoesAway, PuckSeeks): ...


class BoatSeeks(Boat):
    """Its buoy is seen ahead and to the left."""

    def start(self):
        super().start()
        self.last = self.distance()

    def progress(self, before, after):
        return before - after

    def reward(self):
        before, self.last = self.last, self.distance()
        return 5.0 * self.progress(before, self.last)


class RL622BoatGoesAway(GoesAway, BoatSeeks): ...


class PaysSuccess:
    """Pays less with the distance, and a bonus for success, after which the episode goes on."""

    bonus = 1.0

    def reward(self, *_):
        return self.bonus * bool(self.succeeds()) - self.distance()


class CostsSuccess(PaysSuccess):
    """The bonus has the sign of a penalty."""

    rlctl_ignore = {"RL605": "a consequence"}
    bonus = -5.0


class ArmPaysSuccess(PaysSuccess, MujocoArm): ...


class RL622ArmCostsSuccess(CostsSuccess, MujocoArm): ...


class FlyerPaysSuccess(PaysSuccess, FlyerSeeks): ...


class RL622FlyerCostsSuccess(CostsSuccess, FlyerSeeks): ...


class CartPaysSuccess(PaysSuccess, CartSeeks): ...


class RL622CartCostsSuccess(CostsSuccess, CartSeeks): ...


class PuckPaysSuccess(PaysSuccess, PuckSeeks): ...


class RL622PuckCostsSuccess(CostsSuccess, PuckSeeks): ...


class ArmSeesFromHand(MujocoArm):
    """It sees the way to the goal in the frame of its hand."""

    def seen(self, way):
        return self.data.body("hand").xmat.reshape(3, 3).T @ way

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel, self.seen(self.goal - self.tip())])


class RL125ArmHandTurnsBack(ArmSeesFromHand):
    def seen(self, way):
        return self.data.body("hand").xmat.reshape(3, 3) @ way


class ReacherSeesFromHand(Reacher):
    """The same in PyBullet."""

    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "chance does not get there"}

    def turn(self):
        return Rotation.from_quat(self.hand()[5]).inv()

    def to_goal(self):
        return self.turn().apply(super().to_goal())


class RL125ReacherHandTurnsBack(ReacherSeesFromHand):
    def turn(self):
        return super().turn().inv()
