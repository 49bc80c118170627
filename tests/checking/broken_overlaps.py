"""Robots and objects that a reset puts into the floor: less than what would throw them, and the engine pushes them out
within a few steps."""

import numpy as np
import pybullet as p
from mujoco_robots import ARM, MujocoArm
from robots import Crawler, Pusher

CUBE = '<body name="cube" pos=".4 0 .03"><freejoint/><geom type="box" size=".03 .03 .03" mass=".1"/></body>'


class RL803PusherSinksItsCube(Pusher):
    """The cube's place is that of its bottom, and its own is half an edge higher [m]."""

    def put_cube(self, place):
        super().put_cube([*place[:2], place[2] - 0.03])


class RL803CrawlerSinks(Crawler):
    rlctl_ignore = {"RL302": "what pushes it out is chance", "RL610": "and moves it to its goal"}

    def start(self):
        super().start()
        place, turn = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        p.resetBasePositionAndOrientation(
            self.robot, np.subtract(place, [0, 0, 0.05]), turn, physicsClientId=self.client
        )


class ArmAboveCube(MujocoArm):
    """A cube lies on the table."""

    rlctl_ignore = {"RL110": "nothing moves the cube", "RL114": "it is not observed"}
    xml = ARM.replace("</worldbody>", f"{CUBE}</worldbody>")
    height = 0.03  # of the cube [m]

    def start(self):
        self.data.qpos[:3] = self.home + self.np_random.uniform(-0.05, 0.05, 3)
        self.data.qpos[3:6] = [*self.np_random.uniform(0.3, 0.5, 2), self.height]
        self.goal = self.np_random.uniform([0.2, -0.2, 0.2], [0.5, 0.2, 0.6])

    def observe(self):
        return np.concatenate([self.data.qpos[:6], self.data.qvel[:6], self.goal - self.tip()])


class RL803ArmSinksItsCube(ArmAboveCube):
    height = 0.012
