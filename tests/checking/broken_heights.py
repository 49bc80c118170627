"""Robots whose goals are higher or lower than they get, by their joints or by a clipped command; and their twins."""

import mujoco
import numpy as np

from tests.checking.mujoco_robots import MujocoRobot
from tests.checking.robots import Robot

MAST = """
<mujoco><compiler angle="radian"/><option timestep="0.004"/><default><joint damping="2" armature=".02"/></default>
<worldbody><body name="pillar" pos="0 0 .2"><joint name="swing" axis="0 0 1" range="-2.5 2.5"/>
  <geom type="box" size=".05 .05 .1" mass="3"/>
  <body name="slider" pos="0 0 .1"><joint name="rise" type="slide" axis="0 0 1" range="0 .8"/>
    <geom type="box" size=".04 .04 .04" mass="1" contype="0" conaffinity="0"/>
    <body name="boom" pos=".1 0 0"><joint name="extend" type="slide" axis="1 0 0" range="0 .5"/>
      <geom type="box" size=".05 .02 .02" mass=".5" contype="0" conaffinity="0"/>
      <site name="lamp" pos=".1 0 0"/></body></body></body></worldbody>
<actuator><position joint="swing" kp="60"/><position joint="rise" kp="900"/>
<position joint="extend" kp="300"/></actuator>
</mujoco>
"""


class LampMast(MujocoRobot):
    """A lamp on a mast, whose highest place is 1.1 m, is to shine from beside a plant."""

    xml = MAST
    heights = (0.4, 1.0)  # [m]

    def start(self):
        self.data.qpos[:] = self.np_random.uniform([-1, 0.2, 0.1], [1, 0.5, 0.3])
        self.wanted = self.data.qpos.copy()
        angle = self.np_random.uniform(-2, 2)
        away = self.np_random.uniform(0.3, 0.6)
        self.plant = np.array([away * np.cos(angle), away * np.sin(angle), self.np_random.uniform(*self.heights)])

    def lamp(self):
        return self.data.site("lamp").xpos.copy()

    def observe(self):
        plant = getattr(self, "plant", np.zeros(3))
        return np.concatenate([self.data.qpos, self.data.qvel, plant - self.lamp()])

    def move(self, action):
        self.wanted = np.clip(self.wanted + 0.05 * action, [-2.5, 0.0, 0.0], [2.5, 0.8, 0.5])
        self.data.ctrl[:] = self.wanted
        mujoco.mj_step(self.model, self.data, self.frames)

    def reward(self):
        return float(np.exp(-3.0 * np.linalg.norm(self.lamp() - self.plant)))

    def succeeds(self):
        return bool(np.linalg.norm(self.lamp() - self.plant) < 0.08)


class LampMastTooLow(LampMast):
    heights = (0.6, 1.9)


class Microscope(Robot):
    """A lens that is moved along three rails goes to a cell in a dish."""

    joints = 3
    low, high = np.array([0.0, 0.0, 0.01]), np.array([0.2, 0.2, 0.08])  # [m]

    def size(self):
        return 6

    def start(self):
        self.lens = self.np_random.uniform(self.low + 0.01, self.high)
        self.cell = self.np_random.uniform([0.02, 0.02, 0.012], [0.18, 0.18, 0.02])

    def observe(self):
        return np.concatenate([self.lens, self.cell - self.lens]).astype(np.float32)

    def move(self, action):
        self.lens = np.clip(self.lens + 0.01 * action, self.low, self.high)

    def gap(self):
        return float(np.linalg.norm(self.lens - self.cell))

    def reward(self):
        return -5.0 * self.gap()

    def is_success(self):
        return self.gap() < 0.01


class MicroscopeAboveTheDish(Microscope):
    low = np.array([0.0, 0.0, 0.04])


class LampBeside(LampMast):
    """It need not get there: the lamp shines from below as well, and success is a matter of the plane."""

    heights = (1.25, 1.9)

    def reward(self):
        return float(np.exp(-3.0 * np.linalg.norm(self.lamp()[:2] - self.plant[:2])))

    def succeeds(self):
        return bool(np.linalg.norm(self.lamp()[:2] - self.plant[:2]) < 0.08)
