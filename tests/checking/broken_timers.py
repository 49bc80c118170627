"""Robots that measure how long something lasts, next to their twins: the air times of feet, a pause."""

import numpy as np
from broken_clocks import Feet
from mujoco_robots import MujocoHopper
from robots import Pusher


class FeetInAir(Feet):
    """Each leg that swings forwards is in the air; how long is paid where it comes down."""

    def start(self):
        super().start()
        self.air = np.zeros(2)

    def move(self, action):
        super().move(action)
        lands = (self.legs < 0) & (self.air > 0)
        self.terms["air"] = float(((self.air - 0.1) * lands).sum())
        self.air = np.where(self.legs < 0, 0.0, self.air + self.clock_time())

    def clock_time(self):
        return self.dt


class RL826FeetInAirPhysicsTime(FeetInAir):
    def clock_time(self):
        return self.dt / self.substeps


class HopperInAir(MujocoHopper):
    """It observes for how long each of its thighs has been lifted."""

    lifted = None

    def reset(self, *, seed=None, options=None):
        self.lifted = np.zeros(3)
        return super().reset(seed=seed, options=options)

    def clock_time(self):
        return self.model.opt.timestep * self.frames

    def step(self, action):
        self.lifted = (self.lifted + self.clock_time()) * (self.data.qpos[7::2][:3] > 0)
        return super().step(action)

    def observe(self):
        return np.concatenate([super().observe(), np.zeros(3) if self.lifted is None else self.lifted])


class RL826HopperInAirPhysicsTime(HopperInAir):
    rlctl_ignore = {"RL110": "a foot may never lift"}

    def clock_time(self):
        return self.model.opt.timestep


class PusherPauses(Pusher):
    """After each large action it waits for some time in which it moves with half the action."""

    def start(self):
        super().start()
        self.wait = 0.0

    def clock_time(self):
        return 4 / 120

    def move(self, action):
        is_waiting = self.wait > 0
        super().move(0.5 * action if is_waiting else action)
        self.wait = max(0.0, self.wait - self.clock_time())
        if not is_waiting and np.abs(action).max() > 0.6:
            self.wait = 0.1


class RL826PusherPausesPhysicsTime(PusherPauses):
    def clock_time(self):
        return 1 / 120
