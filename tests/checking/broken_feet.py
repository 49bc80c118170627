"""Robots that observe which of their feet touch the ground, next to some that see one of them twice."""

import mujoco
import numpy as np
import pybullet as p
from gymnasium import spaces
from mujoco_robots import MujocoHopper
from robots import Crawler


class HopperFeels(MujocoHopper):
    """It sees them beside the rest, without noise."""

    soles = "left_sole", "right_sole", "back_sole"


class RL835HopperFeelsTheLeftTwice(HopperFeels):
    soles = "left_sole", "left_sole", "back_sole"


class HopperWeighs(MujocoHopper):
    """It feels the force of each foot instead."""

    order = (0, 1, 2)

    def forward(self):
        super().forward()
        mujoco.mj_rnePostConstraint(self.model, self.data)

    def touches(self):
        flags = super().touches()
        forces = self.data.cfrc_ext[[self.model.body(name.replace("sole", "foot")).id for name in self.soles], 5]
        return np.where(flags, np.abs(forces) + 1.0, 0.0)[list(self.order)]


class RL835HopperWeighsTheBackTwice(HopperWeighs):
    order = (0, 2, 2)


class CrawlerFeels(Crawler):
    """It lifts its feet high, and has them in a dictionary, with noise."""

    links = (0, 1)

    def __init__(self):
        super().__init__()
        boxes = {name: spaces.Box(-np.inf, np.inf, (1,), np.float32) for name in ("left_contact", "right_contact")}
        self.observation_space = spaces.Dict({"state": self.observation_space, **boxes})

    def target(self, action):
        return self.home + [1.2, 1.2, 0.4] * action

    def touches(self, link):
        return len(p.getClosestPoints(self.robot, self.floor, 0.002, link, -1, physicsClientId=self.client)) > 0

    def observe(self):
        felt = [self.touches(link) for link in self.links]
        named = dict(zip(("left_contact", "right_contact"), felt, strict=True))
        flags = {name: np.array([flag + self.np_random.normal(0.0, 0.02)], np.float32) for name, flag in named.items()}
        return {"state": super().observe(), **flags}


class RL835CrawlerFeelsTheRightTwice(CrawlerFeels):
    links = (1, 1)
