"""Robots that are paid by the distance to their goal, next to robots that add the differences with their signs."""

import numpy as np
from broken_meaning import Robot, Rover
from broken_reach_bullet import Reacher
from mujoco_robots import MujocoArm


class AddsSizes:
    def reward(self, *action):
        return super().reward(*action) + 0.5 * max(0.0, 1.0 - float(np.abs(self.way()).sum()))


class OnlySigns:
    """Its whole reward is a sum with signs."""

    def reward(self, *action):
        return -float(self.way().sum())


class RoverWay(Rover):
    def way(self):
        return self.goal - self.place


class MujocoWay(MujocoArm):
    def way(self):
        return self.goal - self.tip()


class ReacherWay(Reacher):
    def way(self):
        return self.to_goal()


class RL622RoverAddsSigns(OnlySigns, RoverWay): ...


class RoverAddsSizes(AddsSizes, RoverWay): ...


class RL622ArmAddsSigns(OnlySigns, MujocoWay): ...


class ArmAddsSizes(AddsSizes, MujocoWay): ...


class RL622ReacherAddsSigns(OnlySigns, ReacherWay): ...


class ReacherAddsSizes(AddsSizes, ReacherWay): ...


class Plate(Robot):
    """A plate turns, and a motor pushes the puck on it, to places in the room; the puck and the goal are seen from the
    plate. A goal has to be held for a while, and the second one is the success."""

    rlctl_ignore = {"RL611": "it takes two goals", "RL114": "how long the goal was held is not seen"}
    limit, refreshes = 120, True

    def start(self):
        self.turn = self.np_random.uniform(-1.0, 1.0)
        self.puck, self.speed = self.np_random.uniform(-0.3, 0.3, 2), np.zeros(2)
        self.reached = 0
        self.draw()
        self.before, self.progress = self.distance(), 0.0

    def draw(self):
        self.goal, self.held = self.np_random.uniform(-0.4, 0.4, 2), 0

    def move(self, action):
        self.turn += 0.05 * action[0]
        self.speed = 0.8 * self.speed + 0.02 * action[1] * self.axes()[:, 0]
        self.puck = self.puck + self.speed
        self.progress, self.before = self.before - self.distance(), self.distance()
        self.held = self.held + 1 if self.distance() < 0.05 else 0
        if self.held >= 8:
            self.reached += 1
            self.draw()
            if self.refreshes:
                self.before = self.distance()

    def axes(self):
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        return np.array([[cosine, -sine], [sine, cosine]])

    def distance(self):
        return float(np.linalg.norm(self.goal - self.puck))

    def observe(self):
        seen = [self.axes().T @ vector for vector in (self.puck, self.speed, self.goal)]
        return np.concatenate([[np.cos(self.turn), np.sin(self.turn)], *seen]).astype(np.float32)

    def reward(self, action):
        return 10.0 * self.progress - 0.02 * np.square(action).sum()

    def result(self, reward, success):
        return self.observe(), float(reward), False, self.steps >= self.limit, {"is_success": self.reached >= 2}


class RL627PlateOldGoal(Plate):
    refreshes = False


class PlateNear(Plate):
    def reward(self, action):
        return super().reward(action) + 0.2 * max(0.0, 1.0 - self.distance() / 0.4)


class RL622PlateAddsSigns(Plate):
    def reward(self, action):
        return super().reward(action) + 0.2 * max(0.0, 1.0 - float(np.sum(self.goal - self.puck)) / 0.4)
