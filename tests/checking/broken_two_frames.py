"""Robots that observe a place and a velocity in two frames, next to twins that use frames which belong together."""

import numpy as np
import pybullet as p
from broken_substeps import Airship
from broken_turned import Flyer, Puck


class AirshipInWorld(Airship):
    """As of ships: where it goes in the world's frame, its velocity in its own."""

    def seen_goal(self):
        return self.goal - self.place


class RL125AirshipGoal(Airship):
    def seen_goal(self):
        return self.turn(self.goal - self.place, self.yaw)


class RL127AirshipWind(Airship):
    def seen_velocity(self):
        return self.velocity


class FlyerGoes:
    """It sees the way to a place, with noise."""

    rlctl_ignore = {**Flyer.rlctl_ignore, "RL114": "it is paid for moving ahead, wherever the place is"}

    def start(self):
        super().start()
        self.place = self.np_random.uniform([-2.0, -2.0, 0.5], [2.0, 2.0, 1.5])

    def seen_velocity(self):
        return self.turn().inv().apply(self.data.qvel[:3])

    def observe(self):
        way = self.turn().inv().apply(self.place - self.data.qpos[:3])
        noise = self.np_random.normal(0.0, 0.002, 6)
        return np.concatenate([np.concatenate([way, self.seen_velocity()]) + noise, self.data.qvel[3:]])


class FlyerSees(FlyerGoes, Flyer):
    place = np.zeros(3)


class RL127FlyerSeesWind(FlyerSees):
    def seen_velocity(self):
        return self.data.qvel[:3]


class PuckSees(Puck):
    """A disc that sees the way to a goal, in two numbers each."""

    goal = np.zeros(2)

    def size(self):
        return 5

    def put_back(self):
        super().put_back()
        self.goal = self.np_random.uniform(-1.0, 1.0, 2)

    def seen_velocity(self):
        turn, velocity, _ = self.look()
        return turn.inv().apply(velocity)[:2]

    def observe(self):
        place, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        turn, _, turning = self.look()
        way = turn.inv().apply([*(self.goal - place[:2]), 0.0])
        return np.array([*way[:2], *self.seen_velocity(), turning[2]], np.float32)


class RL127PuckSeesWorld(PuckSees):
    def seen_velocity(self):
        return self.look()[1][:2]
