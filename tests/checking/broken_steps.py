"""Robots that are paid for steps while they stand, and for grasps of air, next to their twins."""

import mujoco
import numpy as np
import pybullet as p
from broken_clocks import Feet
from broken_meaning import Robot
from mujoco_robots import MujocoHopper
from robots import Crawler


class Lifts(Feet):
    """Its joints follow targets, and feet that move are paid for their height."""

    def move(self, action):
        for _ in range(self.substeps):
            pull = 60 * (0.6 * action - self.legs) - 8 * self.rates
            self.rates = self.rates + self.dt / self.substeps * pull
            self.legs = self.legs + self.dt / self.substeps * self.rates
        self.forward += self.dt * (4 * np.abs(self.rates).sum() - 4 * self.forward)
        error = 0.1 * np.abs(self.legs) - 0.05  # [m], of the height of each foot
        paid = np.exp(-np.square(error) / 0.002) * self.weigh(0.3 * np.abs(self.rates))
        self.terms = {"forward": self.forward, "foot_clearance": 0.5 * paid.sum()}

    def weigh(self, speeds):
        return np.tanh(2 * speeds)

    def observe(self):
        noise = self.np_random.normal(0.0, 0.01, 5)
        return (np.array([*self.legs, *self.rates, self.forward]) + noise).astype(np.float32)


class RL628FeetPaidAtRest(Lifts):
    def weigh(self, speeds):
        return np.ones(2)


class HopperSteps(MujocoHopper):
    """The time of its feet in the air is paid when they come down."""

    def reset(self, *, seed=None, options=None):
        self.in_air = np.zeros(3)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        touches = self.touches()
        self.in_air += self.model.opt.timestep * self.frames
        terms = {"moving": reward, "feet_air_time": float(self.pay(touches))}
        self.in_air[touches] = 0.0
        return observation, sum(terms.values()), terminated, truncated, {**info, "reward_terms": terms}

    def pay(self, touches):
        return (self.in_air * touches * (self.in_air > 0.02)).sum()


class RL628HopperPaidAtRest(HopperSteps):
    limit = 220

    def pay(self, touches):
        return np.exp(-np.square(self.in_air * ~touches - 0.1) / 0.05).sum()


class CrawlerLifts(Crawler):
    """Feet that move are paid for their height."""

    def weigh(self, speed):
        return min(speed, 1.0)

    def lifted(self):
        paid = 0.0
        for link in range(2):
            state = p.getLinkState(
                self.robot, link, computeLinkVelocity=1, computeForwardKinematics=1, physicsClientId=self.client
            )
            paid += max(0.0, state[4][2]) * self.weigh(np.hypot(*state[6][:2]))
        return paid

    def reward(self):
        return super().reward() + self.lifted()

    def info(self, success):
        return {**super().info(success), "reward_terms": {"forward": super().reward(), "feet_height": self.lifted()}}


class RL628CrawlerPaidAtRest(CrawlerLifts):
    limit = 220

    def weigh(self, speed):
        return 1.0


class Picker(Robot):
    """A hand in the plane with a gripper goes to an object and closes."""

    rlctl_ignore = {"RL701": "an open gripper opens no further"}
    numbers = 3

    def start(self):
        self.hand, self.object = self.np_random.uniform(-0.5, 0.5, (2, 2))
        self.opening = 1.0
        self.terms = {}

    def move(self, action):
        self.hand = np.clip(self.hand + 0.03 * action[:2], -0.6, 0.6)
        self.opening = float(np.clip(self.opening - 0.15 * action[2], 0.0, 1.0))
        closes = self.opening < 0.3
        if closes and self.is_near():
            self.object = self.hand.copy()
        self.terms = {"reach": -self.distance(), "grasp": float(closes and self.pays())}

    def is_near(self):
        return self.distance() < 0.06

    def pays(self):
        return self.is_near()

    def distance(self):
        return float(np.linalg.norm(self.object - self.hand))

    def observe(self):
        return np.array([*self.hand, self.opening, *(self.object - self.hand)], np.float32)

    def reward(self, action):
        return sum(self.terms.values())

    def result(self, reward, success):
        info = {"is_success": bool(self.opening < 0.3 and self.is_near()), "reward_terms": dict(self.terms)}
        return self.observe(), float(reward), False, self.steps >= self.limit, info


class RL629PickerAnywhere(Picker):
    def pays(self):
        return True


GRIPPER = """
<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="3 3 .1"/>
<body name="hand" pos="0 0 .3">
  <joint name="x" type="slide" axis="1 0 0" range="-.5 .5" limited="true" damping="5"/>
  <joint name="z" type="slide" axis="0 0 1" range="-.2 .2" limited="true" damping="5"/>
  <geom type="box" size=".06 .02 .02" mass=".5"/>
  <body name="left" pos="-.05 0 -.05">
    <joint name="left" type="slide" axis="1 0 0" range="0 .045" limited="true" damping="2"/>
    <geom type="box" size=".005 .02 .03" mass=".05"/></body>
  <body name="right" pos=".05 0 -.05">
    <joint name="right" type="slide" axis="-1 0 0" range="0 .045" limited="true" damping="2"/>
    <geom type="box" size=".005 .02 .03" mass=".05"/></body></body>
<body name="cube" pos=".2 0 .02"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body></worldbody>
<equality><joint joint1="left" joint2="right"/></equality>
<actuator><position joint="x" kp="100"/><position joint="z" kp="150"/><position joint="left" kp="50"/></actuator>
</mujoco>
"""


class Gripper(Robot):
    """A hand on two rails with two fingers; how far these are closed near the cube is paid."""

    rlctl_ignore = {"RL611": "chance does not bring it to the cube"}
    numbers = 3

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(GRIPPER)
        self.data = mujoco.MjData(self.model)
        super().__init__()

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[4] = self.np_random.uniform(-0.4, 0.4)
        mujoco.mj_forward(self.model, self.data)

    def move(self, action):
        self.data.ctrl[:] = [0.5 * action[0], 0.15 * action[1], 0.0225 * (1 + action[2])]
        mujoco.mj_step(self.model, self.data, 4)
        mujoco.mj_forward(self.model, self.data)

    def to_cube(self):
        return self.data.body("cube").xpos - self.data.body("hand").xpos + [0, 0, 0.05]

    def distance(self):
        return float(np.linalg.norm(self.to_cube()))

    def is_paid(self):
        return self.distance() < 0.03

    def observe(self):
        noise = self.np_random.normal(0.0, 0.002, 4)
        return np.concatenate([self.data.qpos[:4], self.data.qvel[:4] + noise, self.to_cube()]).astype(np.float32)

    def list_terms(self):
        closed = self.data.qpos[2] / 0.045
        return {"reach": 1 - np.tanh(5 * self.distance()), "grasp_bonus": float(0.5 * closed * self.is_paid())}

    def reward(self, action):
        return sum(self.list_terms().values())

    def result(self, reward, success):
        info = {"is_success": self.is_paid(), "reward_terms": self.list_terms()}
        return self.observe(), float(reward), False, self.steps >= self.limit, info


class RL629GripperAnywhere(Gripper):
    def is_paid(self):
        return True

    def result(self, reward, success):
        *returned, info = super().result(reward, success)
        return *returned, {**info, "is_success": self.distance() < 0.03}


class RL628HopperLandsAlways(HopperSteps):
    """A foot on the ground counts as one that comes down, after no time in the air."""

    limit = 220

    def pay(self, touches):
        return ((self.in_air - 0.1) * touches).sum()


class GripperHolds(Gripper):
    """It is paid while its fingers touch the cube."""

    def touches(self):
        fingers = {self.model.body(name).geomadr[0] for name in ("left", "right")}
        cube = self.model.body("cube").geomadr[0]
        pairs = [{int(contact.geom1), int(contact.geom2)} for contact in self.data.contact]
        return [{finger, cube} in pairs for finger in fingers]

    def is_paid(self):
        return all(self.touches())

    def list_terms(self):
        return {**super().list_terms(), "grasp_bonus": 0.5 * self.is_paid()}

    def result(self, reward, success):
        *returned, info = super().result(reward, success)
        return *returned, {**info, "is_success": self.distance() < 0.03}


class RL631GripperOneFinger(GripperHolds):
    def is_paid(self):
        return any(self.touches())


class GripperHoldsAnything(GripperHolds):
    """What it calls a touch is one of any finger."""

    def list_terms(self):
        return {"reach": 1 - np.tanh(5 * self.distance()), "touch_bonus": 0.5 * any(self.touches())}


class RL816GripperOpensOutwards(Gripper):
    """Its fingers open in the direction of their axes."""

    def move(self, action):
        super().move(action * [1, 1, 0])
        self.data.ctrl[2] = -0.0225 * (1 + action[2])
        mujoco.mj_step(self.model, self.data, 4)
        mujoco.mj_forward(self.model, self.data)
