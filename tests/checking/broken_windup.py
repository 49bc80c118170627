"""Robots whose actions are added up to a command, next to their twins, which keep the command within its limits and
give all of it to the motors."""

import mujoco
import numpy as np
import pybullet as p
from broken_meaning import Robot
from mujoco_robots import MujocoArm
from robots import Arm


class Gate(Robot):
    """Two slides without an engine follow a command that has ends, with some delay and noise."""

    limit = 100

    def start(self):
        self.command, self.slides = self.np_random.uniform(-0.2, 0.2, 2), np.zeros(2)
        self.goal = self.np_random.uniform(-0.4, 0.4, 2)

    def keep(self, command):
        return np.clip(command, -0.5, 0.5)

    def move(self, action):
        self.command = self.keep(self.command + 0.1 * action)
        self.slides = self.slides + 0.5 * (np.clip(self.command, -0.5, 0.5) - self.slides)

    def observe(self):
        noise = self.np_random.normal(0.0, 0.005, 2)
        return np.array([*self.slides + noise, *self.goal], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.slides))

    def reward(self, action):
        return -self.distance()


class RL708GateRunsOn(Gate):
    def keep(self, command):
        return command


class ArmAddsUp(MujocoArm):
    """An arm in MuJoCo whose actions change the targets of its joints, which are observed."""

    low, high = np.array([-1.0, -0.3, -2.9]), np.array([2.5, 2.4, 2.9])
    kept = np.zeros(3)

    def start(self):
        super().start()
        self.kept = self.home.copy()

    def keep(self, targets):
        return np.clip(targets, self.low, self.high)

    def targets(self, action):
        self.kept = self.keep(self.kept + 0.1 * action)
        return np.clip(self.kept, self.low, self.high)

    def observe(self):
        return np.concatenate([super().observe(), self.kept])


class RL708ArmRunsOn(ArmAddsUp):
    def keep(self, targets):
        return targets


class BulletArmAddsUp(Arm):
    """An arm in PyBullet that hides the targets which its actions change."""

    def start(self):
        self.kept = self.home.copy()
        super().start()

    def keep(self, targets):
        return np.clip(targets, self.home - 0.4, self.home + 0.4)

    def target(self, action):
        self.kept = self.keep(self.kept + 0.1 * action)
        return np.clip(self.kept, self.home - 0.4, self.home + 0.4)


class RL708BulletArmRunsOn(BulletArmAddsUp):
    def keep(self, targets):
        return targets


class RL709ArmForgetsTheWrist(ArmAddsUp):
    def move(self, action):
        self.data.ctrl[self.motors[:2]] = self.targets(action)[:2]
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()


class BulletArmShowsTargets(BulletArmAddsUp):
    """It shows them instead, and its targets begin where the joints are."""

    last = 3

    def size(self):
        return super().size() + 3

    def drive(self, targets):
        self.kept = self.kept if self.has_begun else targets.copy()
        for joint in range(self.last):
            p.setJointMotorControl2(
                self.robot, joint, p.POSITION_CONTROL, targets[joint], force=30.0, physicsClientId=self.client
            )

    def start(self):
        self.has_begun = False
        super().start()
        self.has_begun = True

    def observe(self):
        return np.concatenate([super().observe(), self.kept]).astype(np.float32)


class RL709BulletArmForgetsTheLast(BulletArmShowsTargets):
    last = 2


class ArmWithGripper(ArmAddsUp):
    """A fourth number opens a gripper that no joint has, and that only weighs on the reward."""

    joints = 4
    opening = 0.04

    def start(self):
        super().start()
        self.opening = 0.04

    def move(self, action):
        self.opening = float(np.clip(self.opening + 0.005 * action[3], 0.0, 0.08))
        super().move(action[:3])

    def observe(self):
        return np.concatenate([super().observe(), [self.opening]])

    def reward(self):
        return super().reward() - self.opening


class RL709GripperArmForgetsTheShoulder(ArmWithGripper):
    def move(self, action):
        self.opening = float(np.clip(self.opening + 0.005 * action[3], 0.0, 0.08))
        self.data.ctrl[self.motors[1:]] = self.targets(action[:3])[1:]
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()
