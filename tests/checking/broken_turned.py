"""Robots with a free base that are paid by their heading, next to their twins."""

import mujoco
import numpy as np
import pybullet as p
from mujoco_robots import MujocoHopper, MujocoRobot
from robots import Crawler, Robot
from scipy.spatial.transform import Rotation

FLYER = """
<mujoco><option timestep="0.005"/>
<worldbody><body name="flyer" pos="0 0 1"><freejoint/>
<geom type="box" size=".15 .1 .03" mass="1"/><site name="middle"/></body></worldbody>
<actuator><motor name="push" site="middle" gear="1 0 0 0 0 0" ctrlrange="-3 3"/>
<motor name="lift" site="middle" gear="0 0 1 0 0 0" ctrlrange="0 20"/>
<motor name="turn" site="middle" gear="0 0 0 0 0 1" ctrlrange="-.1 .1"/></actuator></mujoco>
"""
CART = """
<mujoco><option timestep="0.005" cone="elliptic"/><worldbody><geom type="plane" size="9 9 1"/>
<body name="cart" pos="0 0 .1"><freejoint/><geom type="box" size=".2 .12 .04" mass="3"/>
<body name="left" pos="0 .14 -.02"><joint name="left" axis="0 1 0" damping=".02"/>
  <geom type="sphere" size=".08" mass=".2"/></body>
<body name="right" pos="0 -.14 -.02"><joint name="right" axis="0 1 0" damping=".02"/>
  <geom type="sphere" size=".08" mass=".2"/></body>
<geom name="caster" type="sphere" size=".04" pos="-.17 0 -.06" mass=".1" friction="0.01"/></body></worldbody>
<actuator><motor joint="left" gear=".6" ctrlrange="-1 1"/><motor joint="right" gear=".6" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Free(MujocoRobot):
    """A free body that begins with any heading and is paid for moving in the direction in which it looks."""

    height = 1.0

    def start(self):
        self.heading = self.np_random.uniform(-3, 3)
        self.data.qpos[2] = self.height
        self.data.qpos[3:7] = Rotation.from_euler("z", self.heading).as_quat(scalar_first=True)

    def turn(self):
        return Rotation.from_quat(self.data.qpos[3:7], scalar_first=True)

    def ahead(self):
        return float(self.turn().inv().apply(self.data.qvel[:3])[0])

    def observe(self):
        tilt = self.turn().inv().apply([0.0, 0.0, 1.0])
        return np.concatenate([tilt, self.turn().inv().apply(self.data.qvel[:3]), self.data.qvel[3:]])

    def reward(self):
        return self.ahead()

    def succeeds(self):
        return self.ahead() > 0.3

    def yaw(self):
        x, y, _ = self.turn().apply([1.0, 0.0, 0.0])
        return np.arctan2(y, x)


class Flyer(Free):
    rlctl_ignore = {"RL306": "it does not see its heading", "RL110": "it never tilts"}
    xml = FLYER

    def move(self, action):
        self.data.ctrl[:] = [3.0 * action[0], 9.81 + action[1], 0.1 * action[2]]
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()


class Cart(Free):
    xml, joints, height = CART, 2, 0.1

    def move(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()


class North:
    """It is paid for moving along the world's x axis."""

    def ahead(self):
        return float(self.data.qvel[0])


class RL123FlyerNorth(North, Flyer): ...


class RL123CartNorth(North, Cart): ...


class CartNorthOnlyPlaced(RL123CartNorth):
    """Its reset writes positions, and the engine computes nothing before the first step."""

    def forward(self):
        if self.data.time:
            super().forward()


class RL123HopperNorth(North, MujocoHopper): ...


class AnyHeading:
    """It begins with any heading."""

    def start(self):
        self.put_back()
        turn = p.getQuaternionFromEuler([0, 0, self.np_random.uniform(-3, 3)])
        place, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        p.resetBasePositionAndOrientation(self.robot, place, turn, physicsClientId=self.client)


class CrawlerLooks(AnyHeading, Crawler):
    """Its observation has its heading."""

    def put_back(self):
        Crawler.start(self)


class RL123CrawlerNorth(CrawlerLooks):
    rlctl_ignore = {**CrawlerLooks.rlctl_ignore, "RL110": "it does not turn so far"}

    def angles(self):
        return [*super().angles()[:2], 0.0]


class CrawlerNorthOnABox(RL123CrawlerNorth):
    """Its feet begin in the ground, which is a large box, as in PyBullet's plane.urdf."""

    def load(self):
        super().load()
        p.removeBody(self.floor, physicsClientId=self.client)
        box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[100, 100, 5], physicsClientId=self.client)
        self.floor = p.createMultiBody(0, box, basePosition=[0, 0, -4.95], physicsClientId=self.client)


class Puck(AnyHeading, Robot):
    """A disc on ice in PyBullet, with two thrusters."""

    rlctl_ignore = {"RL303": "contacts are not reset to the last bit"}

    def __init__(self):
        super().__init__()
        self.client = p.connect(p.DIRECT)
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        ground = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=self.client)
        self.ground = p.createMultiBody(0, ground, physicsClientId=self.client)
        shape = p.createCollisionShape(p.GEOM_CYLINDER, radius=0.15, height=0.06, physicsClientId=self.client)
        self.robot = p.createMultiBody(1.0, shape, basePosition=[0, 0, 0.03], physicsClientId=self.client)
        p.changeDynamics(self.robot, -1, lateralFriction=0.02, physicsClientId=self.client)
        self.state = p.saveState(physicsClientId=self.client)

    def size(self):
        return 6

    def put_back(self):
        p.restoreState(self.state, physicsClientId=self.client)

    def move(self, action):
        for _ in range(8):
            force = [2.0 * action.sum(), 0, 0]
            p.applyExternalForce(self.robot, -1, force, [0, 0, 0], p.LINK_FRAME, physicsClientId=self.client)
            torque = [0, 0, 0.05 * (action[1] - action[0])]
            p.applyExternalTorque(self.robot, -1, torque, p.LINK_FRAME, physicsClientId=self.client)
            p.stepSimulation(physicsClientId=self.client)

    def look(self):
        _, quaternion = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        velocity, turning = p.getBaseVelocity(self.robot, physicsClientId=self.client)
        return Rotation.from_quat(quaternion), np.array(velocity), np.array(turning)

    def observe(self):
        turn, velocity, turning = self.look()
        return np.concatenate([turn.inv().apply(velocity), turn.inv().apply(turning)]).astype(np.float32)

    def ahead(self):
        turn, velocity, _ = self.look()
        return float(turn.inv().apply(velocity)[0])

    def is_success(self):
        return False

    def reward(self):
        return self.ahead()

    def info(self, success):
        return {"is_success": self.ahead() > 0.5}


class RL123PuckNorth(Puck):
    def ahead(self):
        return float(self.look()[1][0])


class Wanted:
    """It is to look in a direction that is drawn, and sees how far it is from that."""

    wanted = 0.0

    def start(self):
        super().start()
        self.wanted = self.np_random.uniform(-3, 3)

    def error(self):
        return (self.yaw() - self.wanted + np.pi) % (2 * np.pi) - np.pi

    def observe(self):
        away = self.yaw() - self.wanted
        return np.append(super().observe(), [np.cos(away), np.sin(away)]).astype(np.float32)

    def reward(self):
        return super().reward() - 0.5 * abs(self.error())


class RoundAndRound:
    """Its error is not wrapped."""

    def error(self):
        return self.yaw() - self.wanted


class FlyerLooks(Wanted, Flyer): ...


class RL618FlyerLooksRound(RoundAndRound, FlyerLooks): ...


class CartLooks(Wanted, Cart): ...


class RL618CartLooksRound(RoundAndRound, CartLooks): ...


class HopperLooks(Wanted, MujocoHopper):
    def yaw(self):
        return Rotation.from_quat(self.data.qpos[3:7], scalar_first=True).as_euler("xyz")[2]


class RL618HopperLooksRound(RoundAndRound, HopperLooks): ...


class CrawlerLooksAway(Wanted, CrawlerLooks):
    def yaw(self):
        return Crawler.angles(self)[2]

    def size(self):
        return super().size() + 2


class RL618CrawlerLooksRound(RoundAndRound, CrawlerLooksAway): ...


class PuckLooks(Wanted, Puck):
    def yaw(self):
        return self.look()[0].as_euler("xyz")[2]

    def size(self):
        return super().size() + 2


class PuckBesideAWall(RL123PuckNorth):
    """Some resets let a wall rise out of the ground."""

    def __init__(self):
        super().__init__()
        wall = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 1, 1], physicsClientId=self.client)
        self.wall = p.createMultiBody(0, wall, basePosition=[9, 0, -2], physicsClientId=self.client)
        self.state = p.saveState(physicsClientId=self.client)

    def start(self):
        super().start()
        height = self.np_random.choice([0.5, -2.0])
        p.resetBasePositionAndOrientation(self.wall, [9, 0, height], [0, 0, 0, 1], physicsClientId=self.client)


class RL618PuckLooksRound(RoundAndRound, PuckLooks): ...


class FlyerNorthAlwaysTheSame(RL123FlyerNorth):
    def start(self):
        super().start()
        self.data.qpos[3:7] = [1, 0, 0, 0]


class WrongWay:
    """Turns velocities of the world by the orientation, and not back."""

    def observe(self):
        observation = super().observe()
        observation[3:6] = self.turn().apply(self.data.qvel[:3])
        return observation


class RL124FlyerWrongWay(WrongWay, Flyer): ...


class RL124CartWrongWay(WrongWay, Cart): ...


class RL124HopperTurnsTwice(MujocoHopper):
    """MuJoCo has its angular velocity in the frame of its body already."""

    def observe(self):
        observation = super().observe()
        observation[6:9] = self.attitude().inv().apply(self.data.qvel[3:6])
        return observation


class CrawlerTurns(CrawlerLooks):
    def size(self):
        return super().size() + 3

    def rotation(self):
        _, quaternion = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        return Rotation.from_quat(quaternion).inv()

    def observe(self):
        turning = p.getBaseVelocity(self.robot, physicsClientId=self.client)[1]
        return np.concatenate([super().observe(), self.rotation().apply(turning)]).astype(np.float32)


class RL124CrawlerWrongWay(CrawlerTurns):
    def rotation(self):
        return super().rotation().inv()


class RL124PuckWrongWay(Puck):
    def observe(self):
        turn, velocity, turning = self.look()
        return np.concatenate([turn.apply(velocity), turn.inv().apply(turning)]).astype(np.float32)


class Follows:
    """It is paid for a velocity that is drawn, in its own frame, and only where it nearly has that."""

    wanted = np.zeros(2)

    def start(self):
        super().start()
        self.wanted = self.np_random.uniform(-0.3, 0.3, 2)

    def observe(self):
        return np.append(super().observe(), self.wanted).astype(np.float32)

    def velocity(self):
        return self.turn().inv().apply(self.data.qvel[:3])[:2]

    def reward(self):
        return np.exp(-np.square(self.velocity() - self.wanted).sum() / 0.02)


class FollowsNorth(Follows):
    """The velocity is the one in the world."""

    def velocity(self):
        return self.data.qvel[:2]


class FlyerFollows(Follows, Flyer): ...


class RL123FlyerFollowsNorth(FollowsNorth, Flyer): ...


class CartFollows(Follows, Cart): ...


class RL123CartFollowsNorth(FollowsNorth, Cart): ...


class PuckFollows(Follows, Puck):
    def size(self):
        return super().size() + 2

    def velocity(self):
        turn, velocity, _ = self.look()
        return turn.inv().apply(velocity)[:2]


class RL123PuckFollowsNorth(PuckFollows):
    def velocity(self):
        return self.look()[1][:2]
