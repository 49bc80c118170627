"""Robots whose numbers are a hundred times too small or too large: actions, tolerances, lengths."""

import numpy as np
from broken_meaning import Drone, Rover
from broken_progress import BoatSeeks, FlyerSeeks
from broken_reach import Arm as Reach
from broken_reach_bullet import Reacher
from mujoco_robots import MujocoArm, MujocoHopper
from robots import Arm, Crawler, Pusher

# Actions


class RL706ArmOnePercent(MujocoArm):
    gain = 0.006


class RL706HopperOnePercent(MujocoHopper):
    def torques(self, action):
        return super().torques(0.01 * action)


class RL625ReachOnePercent(Reach):
    rlctl_ignore = {"RL611": "a consequence"}

    def move(self, action):
        super().move(0.01 * action)


class RL625RoverOnePercent(Rover):
    def move(self, action):
        super().move(0.01 * action)


class OnePercent:
    def move(self, action):
        super().move(0.01 * action)


class RL625BoatOnePercent(OnePercent, BoatSeeks): ...


class RL625FlyerOnePercent(OnePercent, FlyerSeeks): ...


class RL706BulletArmOnePercent(Arm):
    rlctl_ignore = {"RL611": "a consequence"}

    def target(self, action):
        return super().target(0.01 * action)


class RL706CrawlerOnePercent(Crawler):
    def target(self, action):
        return super().target(0.01 * action)


class RL706PusherOnePercent(Pusher):
    rlctl_ignore = {**Pusher.rlctl_ignore, "RL611": "a consequence"}

    def target(self, action):
        return super().target(0.01 * action)


class RL625RL706ReacherOnePercent(Reacher):
    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "chance does not get there"}

    def target(self, action):
        return super().target(0.01 * action)


# Success


class RL624ArmTolerance(MujocoArm):
    rlctl_ignore = {"RL611": "a consequence", "RL619": "with the tolerance that is meant it is within reach"}

    def succeeds(self):
        return 100 * self.distance() < 0.05


class RL624ReachTolerance(Reach):
    rlctl_ignore = {"RL611": "a consequence"}
    near = 0.001


class RL624RoverTolerance(Rover):
    near = 0.0015


class RL624DroneTolerance(Drone):
    rlctl_ignore = {"RL611": "a consequence"}

    near = 0.0015


class RL624ReacherTolerance(Reacher):
    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "a consequence"}

    def is_success(self):
        return bool(np.linalg.norm(self.to_goal()) < 0.002)


# Observations


class RL119ArmCentimetres(MujocoArm):
    def observe(self):
        observation = super().observe()
        observation[6:] *= 100
        return observation


class RL119ReachCentimetres(Reach):
    def observe(self):
        observation = super().observe()
        observation[6:] *= 100
        return observation


class RL119RoverCentimetres(Rover):
    def observe(self):
        observation = super().observe()
        observation[:2] *= 100
        return observation


class RL119DroneCentimetres(Drone):
    def observe(self):
        observation = super().observe()
        observation[:2] *= 100
        observation[7:] *= 100
        return observation


class RL119HopperCentimetres(MujocoHopper):
    def observe(self):
        observation = super().observe()
        observation[0] *= 100
        return observation


class RL119ReacherCentimetres(Reacher):
    rlctl_ignore = {**Reacher.rlctl_ignore, "RL611": "chance does not reach its goal"}

    def observe(self):
        observation = super().observe()
        observation[6:] *= 100
        return observation


class RL119PusherCentimetres(Pusher):
    def observe(self):
        observation = super().observe()
        observation[6:9] *= 100
        return observation
