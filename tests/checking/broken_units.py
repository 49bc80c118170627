"""Robots whose velocities are over the wrong time or in other units than the rest, next to their twins: in both
engines, with flat and named observations, with noise, and of objects that nobody has touched yet."""

import numpy as np
import pybullet as p
from broken_integration import CartMeasures, FlyerMeasures, PerPhysicsStep, PusherMeasures
from broken_turned import Cart, CrawlerTurns, Flyer, Puck
from gymnasium import spaces
from mujoco_robots import ARM, MujocoArm, MujocoHopper
from robots import Arm
from scipy.spatial.transform import Rotation

BALL = """<body name="ball" pos="-.5 -.5 .03"><freejoint/>
<geom type="box" size=".03 .03 .03" mass=".1"/></body></worldbody>"""


class PusherFar(PusherMeasures):
    """Its cube is where the crank does not reach it."""

    rlctl_ignore = {**PusherMeasures.rlctl_ignore, "RL611": "the crank does not reach the cube"}
    placed = (0.9, 0.5, 0.03)

    def info(self, success):
        return {"is_success": p.getBasePositionAndOrientation(self.cube, physicsClientId=self.client)[0][1] > 0.55}


class RL820PusherFarPerPhysicsStep(PerPhysicsStep, PusherFar): ...


class ArmWithBall(MujocoArm):
    """Nothing moves the ball; its velocity has a name."""

    rlctl_ignore = {"RL110": "the ball keeps its place"}
    xml = ARM.replace("</worldbody>", BALL)
    last = None

    def __init__(self):
        super().__init__()
        ball = spaces.Box(-np.inf, np.inf, (6,), np.float32)
        self.observation_space = spaces.Dict({"robot": self.observation_space, "object": ball})

    def size(self):
        return 9

    def start(self):
        self.data.qpos[:3] = self.home + self.np_random.uniform(-0.05, 0.05, 3)
        self.goal = self.np_random.uniform([0.2, -0.2, 0.2], [0.5, 0.2, 0.6])
        self.last = None

    def seconds(self):
        return self.frames * self.model.opt.timestep

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return self.name(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.name(observation), *rest

    def name(self, observation):
        place = self.data.body("ball").xpos.copy()
        way = np.zeros(3) if self.last is None else place - self.last
        self.last = place
        return {"robot": observation, "object": np.concatenate([place, way / self.seconds()]).astype(np.float32)}

    def observe(self):
        return np.concatenate([self.data.qpos[:3], self.data.qvel[:3], self.goal - self.tip()]).astype(np.float32)


class RL820ArmWithBallPerPhysicsStep(ArmWithBall):
    def seconds(self):
        return self.model.opt.timestep


class RL820ArmWithBallUndivided(ArmWithBall):
    def seconds(self):
        return 1.0


class Undivided:
    def time(self):
        return 1.0


class RL820FlyerUndivided(Undivided, FlyerMeasures):
    rlctl_ignore = {"RL110": "it never tilts"}


class RL820CartUndivided(Undivided, CartMeasures): ...


class RL820PusherUndivided(Undivided, PusherMeasures): ...


class Changes:
    """Instead of the speeds of its joints it sees how far these moved."""

    last = None

    def start(self):
        super().start()
        self.last = None

    def moved(self, positions):
        way = np.zeros(len(positions)) if self.last is None else positions - self.last
        self.last = np.array(positions)
        return way


class RL820HopperChanges(Changes, MujocoHopper):
    def observe(self):
        return np.concatenate([super().observe(), self.data.qvel[3:6], self.moved(self.data.qpos[7:])])


class ArmChangesOnly(Changes, Arm):
    """On purpose, perhaps: nothing else that it sees is a velocity."""

    def observe(self):
        positions = super().observe()[:3]
        return np.concatenate([positions, self.moved(positions)]).astype(np.float32)


class Noise:
    """The observation has noise."""

    noise = 0.01

    def observe(self):
        observation = np.asarray(super().observe())
        return (observation + self.np_random.normal(0.0, self.noise, observation.shape)).astype(np.float32)


class FlyerMeasuresWithNoise(Noise, FlyerMeasures): ...


class RL820FlyerWithNoise(PerPhysicsStep, FlyerMeasuresWithNoise): ...


class PusherMeasuresWithNoise(Noise, PusherMeasures): ...


class RL820PusherWithNoise(PerPhysicsStep, PusherMeasuresWithNoise): ...


# RL119


class GyroInDegrees:
    """The last three elements, an angular velocity, are in degrees per second."""

    def observe(self):
        observation = np.array(super().observe())
        observation[-3:] = np.rad2deg(observation[-3:])
        return observation


class RL119FlyerGyro(GyroInDegrees, Flyer): ...


class RL119CartGyro(GyroInDegrees, Cart):
    rlctl_ignore = {"RL306": "it does not see its heading"}


class RL119CrawlerGyro(GyroInDegrees, CrawlerTurns): ...


class RL119PuckGyro(GyroInDegrees, Puck): ...


class FlyerWithNoise(Noise, Flyer): ...


class RL119FlyerGyroWithNoise(Noise, RL119FlyerGyro): ...


class HopperTurns(MujocoHopper):
    """Its angular velocity in the world's frame, which the engine does not have in qvel."""

    def observe(self):
        return np.append(super().observe(), self.attitude().apply(self.data.qvel[3:6]))


class RL119HopperGyro(GyroInDegrees, HopperTurns): ...


class ArmTipMoves(MujocoArm):
    """It sees the velocity of its tip."""

    factor = 1.0

    def observe(self):
        return np.append(super().observe(), self.factor * self.data.sensordata[3:6])


class RL119ArmTipMillimetres(ArmTipMoves):
    factor = 1000.0


class BulletArmHandMoves(Arm):
    """It sees place, velocity and angular velocity of its hand."""

    factors = 1.0, 1.0, 1.0

    def size(self):
        return 15

    def observe(self):
        state = p.getLinkState(
            self.robot, 3, computeLinkVelocity=1, computeForwardKinematics=1, physicsClientId=self.client
        )
        hand = [np.multiply(f, part) for f, part in zip(self.factors, (state[0], *state[6:8]), strict=True)]
        return np.concatenate([super().observe(), *hand]).astype(np.float32)


class RL119BulletArmHandMillimetres(BulletArmHandMoves):
    factors = 1.0, 1000.0, 1.0


class RL119BulletArmHandPlaceMillimetres(BulletArmHandMoves):
    factors = 1000.0, 1.0, 1.0


class RL119BulletArmHandDegrees(BulletArmHandMoves):
    factors = 1.0, 1.0, 180 / np.pi


class RL119BulletArmHandMillimetresWithNoise(Noise, RL119BulletArmHandMillimetres): ...


class RL119ArmWithBallMillimetres(ArmWithBall):
    """Place and velocity of a ball that nobody moves are in millimetres."""

    def name(self, observation):
        named = super().name(observation)
        return {**named, "object": 1000 * named["object"]}


class RL119PuckHeading(Puck):
    """Its heading is in degrees, its turning in radians per second."""

    def size(self):
        return 7

    def observe(self):
        _, quaternion = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        heading = Rotation.from_quat(quaternion).as_euler("xyz", degrees=True)[2]
        return np.append(super().observe(), np.float32(heading))
