"""Robots that observe one or two axes of a velocity in the wrong frame, next to their twins."""

import gymnasium
import numpy as np
import pybullet as p
from broken_turned import Cart, Flyer, Puck
from gymnasium import spaces


class SeesSpeed:
    """It sees how fast it moves, in its own frame, and no other velocity in the plane."""

    def speed(self):
        return [self.turn().inv().apply(self.data.qvel[:3])[0]]

    def direction(self):
        return []

    def observe(self):
        tilt = self.turn().inv().apply([0.0, 0.0, 1.0])
        return np.concatenate([tilt, self.data.qvel[3:], self.speed(), self.direction()])


class CartSeesSpeed(SeesSpeed, Cart): ...


class RL123CartSeesX(CartSeesSpeed):
    """The velocity along the world's x axis, which is paid too."""

    def speed(self):
        return [self.data.qvel[0]]

    def ahead(self):
        return float(self.data.qvel[0])


class CartSeesXAndYaw(RL123CartSeesX):
    def direction(self):
        return [self.yaw()]


class CartSeesXAndDirection(RL123CartSeesX):
    def direction(self):
        return [np.cos(self.yaw()), np.sin(self.yaw())]


class RL124CartTurnsBack(CartSeesSpeed):
    """One sign of the turn is wrong."""

    def speed(self):
        return [self.data.qvel[0] * np.cos(self.yaw()) - self.data.qvel[1] * np.sin(self.yaw())]


class FlyerSeesSpeed(SeesSpeed, Flyer):
    def speed(self):
        return self.turn().inv().apply(self.data.qvel[:3])


class RL123FlyerSeesWorld(FlyerSeesSpeed):
    """Both axes, far from each other."""

    def speed(self):
        x, y, z = self.data.qvel[:3]
        return [y, z, x]


class FlyerSeesWorldAndDirection(RL123FlyerSeesWorld):
    def direction(self):
        return [np.cos(self.yaw()), np.sin(self.yaw())]


class RL124FlyerTurnsBack(FlyerSeesSpeed):
    rlctl_ignore = {**Flyer.rlctl_ignore, "RL129": "the same line once more"}

    def speed(self):
        x, y, z = self.data.qvel[:3]
        cosine, sine = np.cos(self.yaw()), np.sin(self.yaw())
        return [x * cosine - y * sine, z, x * sine + y * cosine]


class PuckSeesSpeed(Puck):
    """A disc that sees how fast it moves forwards, and turns."""

    frame = p.LINK_FRAME

    def size(self):
        return 2

    def direction(self):
        return []

    def speed(self):
        return self.ahead()

    def observe(self):
        return np.array([self.speed(), self.look()[2][2], *self.direction()], np.float32)

    def move(self, action):
        for _ in range(8):
            force = [2.0 * action.sum(), 0, 0]
            p.applyExternalForce(self.robot, -1, force, self.at(), self.frame, physicsClientId=self.client)
            torque = [0, 0, 0.05 * (action[1] - action[0])]
            p.applyExternalTorque(self.robot, -1, torque, self.frame, physicsClientId=self.client)
            p.stepSimulation(physicsClientId=self.client)

    def at(self):
        return [0, 0, 0]


class RL123PuckSeesX(PuckSeesSpeed):
    def speed(self):
        return self.look()[1][0]


class PuckSeesXAndYaw(RL123PuckSeesX):
    def size(self):
        return 3

    def direction(self):
        return [self.look()[0].as_euler("xyz")[2]]


class PuckPushedInTheWorld(RL123PuckSeesX):
    """Whatever its heading is, an action pushes it along the world's x axis, which is paid."""

    frame = p.WORLD_FRAME

    def at(self):
        return p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)[0]

    def ahead(self):
        return self.look()[1][0]


class RL124PuckTurnsBack(PuckSeesSpeed):
    def speed(self):
        turn, velocity, _ = self.look()
        return turn.apply(velocity)[0]


class Base(gymnasium.Env):
    """A base on three wheels, without an engine, keeps a velocity that is drawn, in its own frame."""

    rlctl_ignore = {"RL609": "it follows a velocity without end"}

    dt, limit = 0.05, 60

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (len(self.start()),), np.float32)

    def start(self):
        self.steps = 0
        self.place, self.velocity, self.yaw_rate = np.zeros(2), np.zeros(2), 0.0
        self.yaw = self.np_random.uniform(-np.pi, np.pi)
        self.wanted = self.np_random.uniform(-0.8, 0.8, 2)
        return self.observe()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.start(), {}

    def axes(self):
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[cosine, -sine], [sine, cosine]])

    def step(self, action):
        action = np.clip(np.nan_to_num(action), -1.0, 1.0).astype(float)
        self.steps += 1
        force = self.axes() @ action[:2]
        self.velocity = self.velocity + (2.0 * force - self.velocity) * self.dt
        self.yaw_rate += (3.0 * action[2] - self.yaw_rate) * self.dt
        self.place = self.place + self.velocity * self.dt
        self.yaw = (self.yaw + self.yaw_rate * self.dt + np.pi) % (2 * np.pi) - np.pi
        error = np.square(self.seen() - self.wanted[: len(self.seen())]).sum()
        return self.observe(), float(np.exp(-2.0 * error)), False, self.steps >= self.limit, {}

    def seen(self):
        return self.axes().T @ self.velocity

    def heading(self):
        return []

    def observe(self):
        return np.array([*self.speed(), self.yaw_rate, *self.wanted, *self.heading()], np.float32)

    def speed(self):
        return self.seen()


class RL129BaseInTheWorld(Base):
    """What it sees and is paid for is the velocity in the world."""

    def seen(self):
        return self.velocity


class RL129BaseSeesX(RL129BaseInTheWorld):
    def speed(self):
        return self.seen()[:1]


class BaseInTheWorldAndYaw(RL129BaseInTheWorld):
    def heading(self):
        return [self.yaw]


class BaseSeesXAndDirection(RL129BaseSeesX):
    def heading(self):
        return [np.cos(self.yaw), np.sin(self.yaw)]


class RL124BaseTurnsBack(Base):
    def seen(self):
        return self.axes() @ self.velocity


class BaseForwards(Base):
    """It keeps a speed forwards, and sees no other."""

    def start(self):
        super().start()
        self.wanted = self.wanted[:1]
        return self.observe()

    def seen(self):
        cosine, sine = self.axes()[:, 0]
        return np.array([self.velocity[0] * cosine + self.velocity[1] * sine])


class RL129BaseForwardsBack(BaseForwards):
    """One sign of the turn is wrong."""

    def seen(self):
        cosine, sine = self.axes()[:, 0]
        return np.array([self.velocity[0] * cosine - self.velocity[1] * sine])


class RL129BaseForwardsInTheWorld(BaseForwards):
    def seen(self):
        return self.velocity[:1]


class BaseForwardsInTheWorldAndYaw(RL129BaseForwardsInTheWorld):
    def heading(self):
        return [self.yaw]
