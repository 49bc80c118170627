"""Maps from actions to commands whose branches do not meet, and twins that jump and do not fall back."""

import numpy as np
from broken_meaning import Drone, Rover
from mujoco_robots import MujocoArm
from robots import Crawler


class Mapped:
    def move(self, action):
        super().move(self.map(action))


class RL707RoverFallsBack(Mapped, Rover):
    """Actions above zero begin at the lowest command again."""

    def map(self, action):
        return np.where(action > 0, 1.5 * action - 1.0, action)


class RL707RoverSwitches(Mapped, Rover):
    """Actions above zero give half as much at once, and more."""

    def map(self, action):
        return np.where(action > 0, 0.5 + 0.5 * action, 0.5 * action)


class FallsBack(Mapped):
    map = RL707RoverFallsBack.map


class Switches(Mapped):
    map = RL707RoverSwitches.map


class RL707DroneFallsBack(FallsBack, Drone): ...


class RL707DroneSwitches(Switches, Drone): ...


class RL707ArmFallsBack(FallsBack, MujocoArm): ...


class RL707ArmSwitches(Switches, MujocoArm): ...


class RL707CrawlerFallsBack(FallsBack, Crawler): ...


class RL707CrawlerSwitches(Switches, Crawler): ...
