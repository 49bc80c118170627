"""Robots whose loops alone say how many steps of the physics a step has, next to their twins."""

import numpy as np
from broken_clocks import HopperByTime
from broken_meaning import Robot
from gymnasium import spaces

DT, PARTS = 0.1, 5
H = DT / PARTS


class Airship(Robot):
    """It flies to a place, and observes with noise, in a dictionary, also how much of the time is left."""

    rlctl_ignore = {"RL611": "chance does not reach its place"}
    limit = 120

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (self.numbers,), np.float32)
        self.reset(seed=0)
        parts = {name: spaces.Box(-np.inf, np.inf, part.shape) for name, part in self.observe().items()}
        self.observation_space = spaces.Dict(parts)

    def start(self):
        self.place, self.velocity = np.zeros(3), np.zeros(3)
        self.yaw, self.yaw_rate = self.np_random.uniform(-3, 3), 0.0
        self.goal = self.np_random.uniform(-2.0, 2.0, 3)
        self.ticks = 0

    def turn(self, vector, angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])

    def seen_goal(self):
        return self.turn(self.goal - self.place, -self.yaw)

    def seen_velocity(self):
        return self.turn(self.velocity, -self.yaw)

    def observe(self):
        noise = self.np_random.normal
        parts = {
            "goal": self.seen_goal() + noise(0, 0.02, 3),
            "velocity": self.seen_velocity() + noise(0, 0.02, 3),
            "yaw_rate": np.array([self.yaw_rate + noise(0, 0.01)]),
            "heading": np.array([np.cos(self.yaw), np.sin(self.yaw)]),
            "time_left": np.array([max(0.0, 1.0 - self.ticks / self.limit)]),
        }
        return {name: part.astype(np.float32) for name, part in parts.items()}

    def step(self, action):
        self.advance(action)
        return self.result(self.reward(action), self.distance() < self.near)

    def turn_time(self):
        return H

    def move(self, action):
        for _ in range(PARTS):
            self.substep(action)
        self.ticks += 1

    def substep(self, action):
        force = self.turn(np.array([action[0], 0.0, 0.0]), self.yaw) - 0.4 * self.velocity
        self.velocity = self.velocity + H * force
        self.place = self.place + H * self.velocity
        self.yaw_rate += H * (2.0 * action[1] - self.yaw_rate)
        self.yaw += self.turn_time() * self.yaw_rate

    def distance(self):
        return float(np.linalg.norm(self.goal - self.place))

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL832AirshipTurnsFast(Airship):
    def turn_time(self):
        return DT


class RL826AirshipCountsAll(Airship):
    def substep(self, action):
        super().substep(action)
        self.ticks += 1

    def move(self, action):
        super().move(action)
        self.ticks -= 1


class Press(Robot):
    """Two slides, with a time of the control and a frequency of the physics."""

    control_s, physics_hz, limit = 0.04, 200.0, 90
    dt = control_s

    def start(self):
        self.slides, self.speeds = self.np_random.uniform(-0.5, 0.5, 2), np.zeros(2)
        self.goal = self.np_random.uniform(-1.0, 1.0, 2)
        self.seconds = 0.0

    def observe(self):
        return np.array([*self.slides, *self.speeds, *self.goal, self.seconds], np.float32)

    def clock_step(self):
        return self.control_s

    def move(self, action):
        rounds = round(self.control_s * self.physics_hz)
        for _ in range(rounds):
            self.speeds = self.speeds + (6.0 * action - self.speeds) / self.physics_hz
            self.slides = self.slides + self.slide_times() * self.speeds
        self.seconds += self.clock_step()

    def slide_times(self):
        return np.full(2, 1 / self.physics_hz)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.slides))

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL826PressSlowClock(Press):
    def clock_step(self):
        return 1 / self.physics_hz


class RL832PressSlidesFast(Press):
    rlctl_ignore = {"RL603": "a consequence"}

    def slide_times(self):
        return np.array([1 / self.physics_hz, self.control_s])


class HopperTimeLeft(HopperByTime):
    """The time that is left is observed [s]."""

    def observe(self):
        *rest, elapsed = super().observe()
        return np.array([*rest, self.limit * self.frames * self.model.opt.timestep - elapsed])


class RL826HopperTimeLeft(HopperTimeLeft):
    def clock_step(self):
        return self.model.opt.timestep * self.frames**2
