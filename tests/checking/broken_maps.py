"""Maps from actions to commands whose branches do not meet, and twins that jump and do not fall back."""

import numpy as np
from broken_meaning import Drone, Rover
from mujoco_robots import MujocoArm
from robots import Crawler


class FallsBack:
    """Actions above zero begin at the lowest command again."""

    def map(self, action):
        return np.where(action > 0, 1.5 * action - 1.0, action)


class Switches:
    """Actions above zero give half as much at once, and more."""

    def map(self, action):
        return np.where(action > 0, 0.5 + 0.5 * action, 0.5 * action)


class Mapped:
    def move(self, action):
        super().move(self.map(action))


class RL707RoverFallsBack(FallsBack, Mapped, Rover): ...


class RL707RoverSwitches(Switches, Mapped, Rover): ...


class RL707DroneFallsBack(FallsBack, Mapped, Drone): ...


class RL707DroneSwitches(Switches, Mapped, Drone): ...


class RL707ArmFallsBack(FallsBack, Mapped, MujocoArm): ...


class RL707ArmSwitches(Switches, Mapped, MujocoArm): ...


class RL707CrawlerFallsBack(FallsBack, Mapped, Crawler): ...


class RL707CrawlerSwitches(Switches, Mapped, Crawler): ...
