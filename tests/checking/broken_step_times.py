"""Robots whose steps take another time than they declare, next to their twins."""

import math

import mujoco
import numpy as np
import pybullet as p
from broken_meaning import Robot
from broken_turned import Cart, Flyer, Puck
from mujoco_robots import MujocoHopper


class RL831FlyerStepsOnce(Flyer):
    """It declares the five steps of the physics that it should take."""

    frame_skip = 5
    metadata = {"render_fps": 40}  # 5 * 0.005 s

    def move(self, action):
        self.data.ctrl[:] = [3.0 * action[0], 9.81 + action[1], 0.1 * action[2]]
        mujoco.mj_step(self.model, self.data)
        self.forward()


class FlyerSteps(Flyer):
    frame_skip = 5
    metadata = {"render_fps": 40}


class CartRecordsSlowly(Cart):
    """Its videos have another rate; nothing is wrong with it."""

    frame_skip = 5
    metadata = {"render_fps": 20}


class HopperSteps(MujocoHopper):
    control_dt, decimation = 0.01, 5  # [s], steps of 0.002 s


class FlyerWaitsForNoFrame(FlyerSteps):
    frames_until_pause = math.inf


class RL831HopperStepsTwice(HopperSteps):
    def move(self, action):
        super().move(action)
        super().move(action)


class PuckSteps(Puck):
    DT, SUBSTEPS = 8 / 240, 8


class RL831PuckStepsOnce(PuckSteps):
    rlctl_ignore = {**PuckSteps.rlctl_ignore, "RL302": "contacts are kept, and the first step of the physics shows it"}

    def move(self, action):
        force = [2.0 * action.sum(), 0, 0]
        p.applyExternalForce(self.robot, -1, force, [0, 0, 0], p.LINK_FRAME, physicsClientId=self.client)
        p.stepSimulation(physicsClientId=self.client)


class Glider(Robot):
    """A glider in a plane, in substeps."""

    dt, substeps, limit = 0.1, 5, 80

    def start(self):
        self.place, self.speed = np.zeros(2), np.zeros(2)
        self.pitch, self.rate = self.np_random.uniform(-0.2, 0.2), 0.0
        self.goal = self.np_random.uniform(-1.0, 1.0, 2)

    def observe(self):
        attitude = [np.sin(self.pitch), np.cos(self.pitch), self.rate]
        return np.array([*(self.goal - self.place), *self.speed, *attitude], np.float32)

    def turn_time(self):
        return self.dt / self.substeps

    def move(self, action):
        step = self.dt / self.substeps
        for _ in range(self.substeps):
            force = np.array([np.cos(self.pitch), np.sin(self.pitch)]) * action[0] - 0.5 * self.speed
            self.speed = self.speed + step * force
            self.place = self.place + step * self.speed
            self.rate += step * (2.0 * action[1] - self.rate)
            self.pitch += self.turn_time() * self.rate

    def distance(self):
        return float(np.linalg.norm(self.goal - self.place))

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL832GliderTurnsTooFast(Glider):
    def turn_time(self):
        return self.dt


class Trolley(Robot):
    """A trolley on a rail with a load that swings, in substeps."""

    dt, substeps, limit = 0.08, 4, 80

    def start(self):
        self.place, self.speed = self.np_random.uniform(-0.5, 0.5), 0.0
        self.swing, self.swing_rate = self.np_random.uniform(-0.3, 0.3), 0.0
        self.goal = self.np_random.uniform(-1.0, 1.0)

    def observe(self):
        return np.array([self.place, self.speed, self.swing, self.swing_rate, self.goal], np.float32)

    def move(self, action):
        step = self.dt / self.substeps
        for _ in range(self.substeps):
            push = 2.0 * action[0] + action[1] - self.speed
            self.speed += step * push
            self.place += step * self.speed
            self.swing_rate += step * (-9.81 * self.swing - push - 0.3 * self.swing_rate)
        self.advance_swing(step)

    def advance_swing(self, step):
        self.swing += self.dt * self.swing_rate

    def distance(self):
        return abs(self.goal - self.place)

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL832TrolleySwingsTooSlowly(Trolley):
    rlctl_ignore = {"RL820": "the swing and its rate show it as well"}

    def advance_swing(self, step):
        self.swing += step * self.swing_rate


class Arm(Robot):
    """An arm of two joints without gravity, in substeps."""

    control_dt, n_substeps, limit = 0.05, 10, 80

    def start(self):
        self.angles, self.rates = self.np_random.uniform(-1.0, 1.0, 2), np.zeros(2)
        self.goal = self.np_random.uniform(-1.0, 1.0, 2)

    def observe(self):
        return np.concatenate([self.angles, self.rates, self.goal]).astype(np.float32)

    def times(self):
        return np.full(2, self.control_dt / self.n_substeps)

    def move(self, action):
        step = self.control_dt / self.n_substeps
        for _ in range(self.n_substeps):
            self.rates = self.rates + step * (8.0 * action - self.rates)
            self.angles = self.angles + self.times() * self.rates

    def distance(self):
        return float(np.linalg.norm(self.goal - self.angles))

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL832ArmElbowTooFast(Arm):
    rlctl_ignore = {"RL603": "a consequence"}

    def times(self):
        return np.array([self.control_dt / self.n_substeps, self.control_dt])
