"""Robots whose actions are scaled to what their motors can do, next to some that scale them twice."""

import mujoco
import numpy as np
import pybullet as p
from broken_meaning import Robot
from mujoco_robots import ARM, MujocoArm
from robots import Arm

MOTORS = "".join(f'<motor name="{name}" joint="{name}"/>' for name in ("shoulder", "elbow", "wrist"))
TORQUE_ARM = ARM[: ARM.index("<actuator>")] + f"<actuator>{MOTORS}</actuator></mujoco>"


class Barge(Robot):
    """Two thrusters in the plane without an engine answer with some delay; where it is has noise."""

    limit = 100
    max_thrust = 0.3  # [N]

    def start(self):
        self.thrust, self.velocity = np.zeros(2), np.zeros(2)
        self.place = self.np_random.uniform(-0.3, 0.3, 2)

    def scale(self, action):
        return action

    def move(self, action):
        command = self.scale(action)
        for _ in range(5):
            self.thrust += 0.2 * (command * self.max_thrust - self.thrust)
            self.velocity += 0.02 * (self.thrust - 0.4 * self.velocity)
            self.place = self.place + 0.02 * self.velocity

    def observe(self):
        return np.array([*self.place + self.np_random.normal(0.0, 0.002, 2), *self.velocity], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.place))

    def reward(self, action):
        return -self.distance()


class RL836BargeScalesTwice(Barge):
    rlctl_ignore = {"RL610": "it hardly leaves where it begins"}

    def scale(self, action):
        return action * self.max_thrust


class TorqueArm(MujocoArm):
    """Torques of three motors in MuJoCo."""

    xml = TORQUE_ARM
    max_torque = 7.0  # [N m]

    def __init__(self):
        super(MujocoArm, self).__init__()

    def scale(self, action):
        return action

    def move(self, action):
        self.data.ctrl[:] = self.max_torque * self.scale(action)
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()


class RL836TorqueArmScalesTwice(TorqueArm):
    def scale(self, action):
        return self.max_torque * action


class BulletTorqueArm(Arm):
    """Torques of three motors in PyBullet, which are kept."""

    torque_limit = 6.0  # [N m]

    def scale(self, action):
        return action

    def start(self):
        self.torques = np.zeros(3)
        super().start()

    def drive(self, targets):
        p.setJointMotorControlArray(
            self.robot, range(3), p.VELOCITY_CONTROL, forces=[0.0] * 3, physicsClientId=self.client
        )

    def move(self, action):
        self.torques = self.torque_limit * self.scale(action)
        for _ in range(4):
            p.setJointMotorControlArray(
                self.robot, range(3), p.TORQUE_CONTROL, forces=self.torques.tolist(), physicsClientId=self.client
            )
            p.stepSimulation(physicsClientId=self.client)


class RL836BulletArmScalesTwice(BulletTorqueArm):
    rlctl_ignore = {"RL805": "six times the torque turns the wrist too fast"}

    def scale(self, action):
        return self.torque_limit * action
