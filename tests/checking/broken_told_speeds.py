"""Robots that tell or pay a speed over the time of a step of the physics, next to their twins."""

import numpy as np
import pybullet as p
from broken_substeps import DT, PARTS, Airship
from broken_turned import Flyer, Puck


class FlyerTells(Flyer):
    """It tells the speed along its heading, as an average over the step."""

    def measure_time(self):
        return self.model.opt.timestep * self.frames

    def move(self, action):
        before = self.data.qpos[:2].copy()
        super().move(action)
        yaw = self.yaw()
        self.speed = float((self.data.qpos[:2] - before) @ [np.cos(yaw), np.sin(yaw)]) / self.measure_time()

    def reward(self):
        return np.exp(-((self.speed - 0.3) ** 2) / 0.1)

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "speed": self.speed}


class RL820FlyerTellsPerPhysicsStep(FlyerTells):
    rlctl_ignore = {**FlyerTells.rlctl_ignore, "RL606": "chance moves it backwards"}

    def measure_time(self):
        return self.model.opt.timestep


class PuckPaysItsWay(Puck):
    """It pays the way along the x axis by the time, less a cost of the action, and tells nothing of it."""

    rlctl_ignore = {**Puck.rlctl_ignore, "RL123": "it pays a direction of the world on purpose"}
    way = 0.0

    def measure_time(self):
        return 8 / 240

    def move(self, action):
        before, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        super().move(action)
        after, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        self.way = 0.7 * (after[0] - before[0]) / self.measure_time() - 0.1 * np.square(action).sum()

    def reward(self):
        return self.way


class RL820PuckPaysPerPhysicsStep(PuckPaysItsWay):
    def measure_time(self):
        return 1 / 240


class AirshipTells(Airship):
    """A robot without an engine that tells how fast it moves, in its axes, and pays it."""

    def measure_time(self):
        return DT

    def move(self, action):
        before, self.yaw_before = self.place, self.yaw
        super().move(action)
        self.ahead = self.turn(self.place - before, -self.yaw)[0] / self.measure_time()

    def result(self, reward, success):
        *rest, info = super().result(reward, success)
        return *rest, {**info, "ahead": self.ahead}


class RL820AirshipTellsPerPart(AirshipTells):
    def measure_time(self):
        return DT / PARTS
