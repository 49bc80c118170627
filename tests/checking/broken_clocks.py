"""Robots whose clocks and accelerations are about steps of the physics, next to their twins."""

import numpy as np
import pybullet as p
from broken_meaning import Robot
from mujoco_robots import MujocoHopper
from robots import Pusher


class Feet(Robot):
    """Two legs swing by a clock that has a period; each step has five steps of the physics."""

    rlctl_ignore = {"RL611": "it walks on and on"}
    dt = 0.02  # of a step [s]
    substeps = 5
    gait_period = 0.8  # [s]

    def start(self):
        self.legs = self.np_random.uniform(-0.3, 0.3, 2)
        self.rates = np.zeros(2)
        self.forward = 0.0
        self.phase = 0.0
        self.terms = {}

    def move(self, action):
        before = self.rates.copy()
        for _ in range(self.substeps):
            self.rates = self.rates + self.dt / self.substeps * (20 * action - 5 * self.legs - self.rates)
            self.legs = self.legs + self.dt / self.substeps * self.rates
        self.forward += self.dt * (np.abs(self.rates).sum() - self.forward)
        self.phase = (self.phase + self.clock_step() / self.gait_period) % 1.0
        acceleration = (self.rates - before) / self.acceleration_time()
        self.terms = {"forward": self.forward, "acceleration": -3e-4 * np.square(acceleration).sum()}

    def clock_step(self):
        return self.dt

    def acceleration_time(self):
        return self.dt

    def observe(self):
        turn = 2 * np.pi * self.phase
        return np.array([*self.legs, *self.rates, self.forward, np.sin(turn), np.cos(turn)], np.float32)

    def distance(self):
        return 1.0

    def reward(self, action):
        return sum(self.terms.values())

    def result(self, reward, success):
        observation, reward, terminated, truncated, info = super().result(reward, success)
        return observation, reward, terminated, truncated, {**info, "reward_terms": dict(self.terms)}


class RL826FeetSlowClock(Feet):
    def clock_step(self):
        return self.dt / self.substeps


class RL827FeetPhysicsTime(Feet):
    def acceleration_time(self):
        return self.dt / self.substeps


class FeetByHertz(Feet):
    """How often its clock goes round is declared."""

    gait_hz = 1.25
    gait_period = property(lambda self: 1 / self.gait_hz)


class RL826FeetSlowHertz(FeetByHertz):
    def clock_step(self):
        return self.dt / self.substeps


class FeetBySine(Feet):
    """Only a sine of the clock is observed."""

    counted = 1

    def start(self):
        super().start()
        self.ticks = 0

    def clock_step(self):
        self.ticks += self.counted
        return self.dt * self.counted

    def observe(self):
        return super().observe()[:6]


class RL826FeetCountsAll(FeetBySine):
    """Each step of the physics counts as a whole step."""

    counted = Feet.substeps


class HopperByTime(MujocoHopper):
    """The time since the reset is observed, with sensors that have noise."""

    elapsed = 0.0

    def reset(self, *, seed=None, options=None):
        self.elapsed = 0.0
        return super().reset(seed=seed, options=options)

    def clock_step(self):
        return self.model.opt.timestep * self.frames

    def step(self, action):
        self.elapsed += self.clock_step()
        return super().step(action)

    def observe(self):
        noise = self.np_random.normal(0.0, 1e-3, self.data.qvel.size)
        return np.concatenate([self.data.qpos[2:], self.data.qvel + noise, [self.elapsed]])


class RL826HopperSlowTime(HopperByTime):
    def clock_step(self):
        return self.model.opt.timestep


class PusherBySeconds(Pusher):
    """Its episodes last a time, in seconds."""

    episode_seconds = 1.0

    def start(self):
        super().start()
        self.elapsed = 0.0

    def clock_step(self):
        return 4 / 120

    def step(self, action):
        self.elapsed += self.clock_step()
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, self.elapsed >= self.episode_seconds - 1e-6, info


class RL826PusherSlowTime(PusherBySeconds):
    def clock_step(self):
        return 1 / 120


class PusherSmooth(Pusher):
    """A penalty for the acceleration of its joints, among the terms."""

    def start(self):
        super().start()
        self.before = self.speeds()

    def speeds(self):
        return np.array([state[1] for state in p.getJointStates(self.robot, range(3), physicsClientId=self.client)])

    def acceleration_time(self):
        return 4 / 120

    def move(self, action):
        super().move(action)
        speeds = self.speeds()
        self.cost = -0.004 * np.abs((speeds - self.before) / self.acceleration_time()).sum()
        self.before = speeds

    def info(self, success):
        return {**super().info(success), "rewards": {"acceleration": self.cost}}


class RL827PusherPhysicsTime(PusherSmooth):
    def acceleration_time(self):
        return 1 / 120


class HopperSmooth(MujocoHopper):
    """A penalty for the accelerations of its joints, among the terms."""

    def reset(self, *, seed=None, options=None):
        returned = super().reset(seed=seed, options=options)
        self.before = self.data.qvel[6:].copy()
        return returned

    def acceleration_time(self):
        return self.model.opt.timestep * self.frames

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        acceleration = (self.data.qvel[6:] - self.before) / self.acceleration_time()
        self.before = self.data.qvel[6:].copy()
        terms = {"moving": reward, "joint_acceleration": -2.5e-7 * float(np.square(acceleration).sum())}
        return observation, sum(terms.values()), terminated, truncated, {**info, "reward_terms": terms}


class RL827HopperPhysicsTime(HopperSmooth):
    def acceleration_time(self):
        return self.model.opt.timestep
