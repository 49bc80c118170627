"""Robots in MuJoCo whose environments compute torques, one with the wrong sign each, and twins."""

import re

import mujoco
import numpy as np
from broken_turned import Cart
from mujoco_robots import ARM, MujocoArm, MujocoHopper, MujocoRobot

CRANE = """
<mujoco><option timestep="0.005"/><worldbody>
<body name="trolley" pos="0 0 1"><joint name="rail" type="slide" axis="1 0 0" range="-1 1" damping=".5"/>
  <geom type="box" size=".1 .08 .04" mass="2" contype="0"/>
  <body name="load"><joint name="rope" axis="0 1 0" damping=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".3" contype="0"/></body></body></worldbody>
<actuator><motor name="pull" joint="rail" ctrlrange="-60 60"/></actuator></mujoco>
"""
LEVER = """
<mujoco><option timestep="0.004"/><worldbody>
<body name="rod" pos="0 0 1"><joint name="pivot" axis="0 1 0" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0 0 .4" size=".02" mass=".5"/></body></worldbody>
<actuator><motor name="turn" joint="pivot" gear="-2" ctrlrange="-20 20"/></actuator></mujoco>
"""
TORQUES = re.sub(r' (kp|ctrlrange)="[^"]*"', "", ARM.replace("<position ", "<motor "))


class Repels:
    """Its springs push away from the target."""

    sign = -1.0


class HopperDamps(MujocoHopper):
    sign = 1.0

    def torques(self, action):
        stiffness, damping = self.gains
        spring = self.sign * stiffness * (self.home + 0.4 * action - self.positions())
        return spring - damping * self.data.qvel[6:]


class RL824HopperRepels(Repels, HopperDamps):
    rlctl_ignore = {"RL803": "it is pushed until its legs are inside its body"}


class RL824HopperShakes(HopperDamps):
    """Its damping has the wrong sign."""

    rlctl_ignore = {"RL803": "it shakes until its legs are inside its body"}
    gains = 30.0, -2.0


class ArmDamps(MujocoArm):
    """Torques, in the order of its motors, with its weight compensated."""

    xml, sign = TORQUES, 1.0

    def targets(self, action):
        away = self.home + 0.6 * action - self.data.qpos
        return self.data.qfrc_bias + self.sign * np.array([60.0, 40.0, 10.0]) * away - 2.0 * self.data.qvel


class RL824ArmRepels(Repels, ArmDamps): ...


class CartKeepsSpeed(Cart):
    """Its wheels have a speed to keep."""

    sign = 1.0

    def move(self, action):
        speeds = self.data.qvel[6:8]
        super().move(np.clip(self.sign * 0.3 * (8.0 * action - speeds), -1.0, 1.0))


class RL824CartRepels(Repels, CartKeepsSpeed): ...


class Crane(MujocoRobot):
    """A trolley with a load that swings goes to a place on its rail."""

    xml, joints, sign = CRANE, 1, 1.0

    def start(self):
        self.data.qpos[:] = self.np_random.uniform(-0.2, 0.2, 2)

    def move(self, action):
        for _ in range(self.frames):
            away = 0.8 * action[0] - self.data.qpos[0]
            self.data.ctrl[0] = np.clip(self.sign * 80.0 * away - 15.0 * self.data.qvel[0], -60.0, 60.0)
            mujoco.mj_step(self.model, self.data)
        self.forward()

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reward(self):
        return -abs(self.data.qpos[0] - 0.5)

    def succeeds(self):
        return abs(self.data.qpos[0] - 0.5) < 0.05


class RL824CraneRepels(Repels, Crane): ...


class Lever(MujocoRobot):
    """A rod stands upright on a motor with a negative gear."""

    xml, joints, sign = LEVER, 1, 1.0

    def start(self):
        self.data.qpos[:] = self.np_random.uniform(-0.2, 0.2, 1)

    def move(self, action):
        for _ in range(self.frames):
            away = 0.5 * action[0] - self.data.qpos[0]
            torque = self.sign * 20.0 * away - 0.8 * self.data.qvel[0]
            self.data.ctrl[0] = np.clip(torque / -2.0, -20.0, 20.0)
            mujoco.mj_step(self.model, self.data)
        self.forward()

    def observe(self):
        angle = self.data.qpos[0]
        return np.array([np.cos(angle), np.sin(angle), self.data.qvel[0]])

    def reward(self):
        return np.cos(self.data.qpos[0])

    def succeeds(self):
        return abs(self.data.qpos[0]) < 0.05


class RL824LeverRepels(Repels, Lever):
    rlctl_ignore = {"RL118": "it is pushed until it spins"}
