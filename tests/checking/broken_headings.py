"""Robots that turn to an angle, which is drawn from a whole turn: the way there is never longer than half of one."""

import mujoco
import numpy as np
from broken_meaning import Drone, Rover
from mujoco_robots import MujocoRobot

DIAL = """
<mujoco><option timestep=".005"/><worldbody>
<body name="dial"><joint name="dial" axis="0 0 1" damping=".02"/>
  <geom type="cylinder" size=".1 .02" mass=".5"/><geom type="box" pos=".08 0 0" size=".02 .01 .03" mass=".05"/>
</body></worldbody><actuator><motor joint="dial" ctrlrange="-1 1" gear=".2"/></actuator></mujoco>
"""
WRAPS = {"RL117": "the goal is an angle too"}


class RoverTurns(Rover):
    """The goal is the heading [rad]."""

    rlctl_ignore = WRAPS
    limit = 40

    def draw_goal(self):
        return self.np_random.uniform(-3.0, 3.0)

    def observe(self):
        return np.array([self.heading, self.goal, *self.speed], np.float32)

    def distance(self):
        return abs((self.heading - self.goal + np.pi) % (2 * np.pi) - np.pi)

    def reward(self, action):
        return 1.0 - self.distance() / np.pi

    def result(self, reward, success):
        observation, reward, _, truncated, info = super().result(reward, success)
        return observation, reward, False, truncated, info


class RL622RoverTurnsAway(RoverTurns):
    def reward(self, action):
        return self.distance()


class DroneTurns(RoverTurns, Drone):
    """The goal is the pitch in degrees, whose error is taken the shorter way round."""

    near = 10.0  # [deg]

    def start(self):
        Drone.start(self)
        self.goal = self.np_random.uniform(-170.0, 170.0)

    def move(self, action):
        Drone.move(self, action)

    def observe(self):
        return np.array([np.rad2deg(self.pitch), self.rate, self.goal, *self.speed], np.float32)

    def distance(self):
        error = abs(np.rad2deg(self.pitch) - self.goal)
        return min(error, 360.0 - error)

    def reward(self, action):
        return np.exp(-self.distance() / 60.0)


class RL622DroneTurnsAway(DroneTurns):
    def reward(self, action):
        return self.distance() / 90.0


class Dial(MujocoRobot):
    """A dial without stops, which may turn many times."""

    rlctl_ignore = WRAPS
    xml, joints, goal = DIAL, 1, 0.0

    def start(self):
        self.data.qpos[0] = self.np_random.uniform(-1.5, 1.5)
        self.goal = self.np_random.uniform(-2.8, 2.8)

    def move(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()

    def observe(self):
        angle = (self.data.qpos[0] + np.pi) % (2 * np.pi) - np.pi
        return np.array([angle, self.data.qvel[0], self.goal])

    def reward(self):
        return np.cos(self.data.qpos[0] - self.goal)

    def succeeds(self):
        return bool(self.reward() > 0.998)


class RL622DialTurnsAway(Dial):
    def reward(self):
        return -np.cos(self.data.qpos[0] - self.goal)

    def succeeds(self):
        return bool(self.reward() < -0.998)
