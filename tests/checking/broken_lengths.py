"""Robots that follow commands, in NumPy, PyBullet and MuJoCo, next to robots that are paid for the length of a command
in any direction."""

import numpy as np
from broken_quadrotor import Quadrotor
from broken_turned import Cart, Flyer
from broken_wheels import Wheels


class RL633QuadrotorAnyDirection(Quadrotor):
    def components(self, a):
        error = np.linalg.norm(self.body_vel()) - np.linalg.norm(self.wanted[:3])
        return {**super().components(a), "vel": np.exp(-(error**2) / 0.5)}


class RL633WheelsAnyDirection(Wheels):
    """It may drive backwards."""

    def pay(self, a):
        v, _, _ = self.motion()
        error = abs(v[0]) - abs(self.target_speed)
        return {**super().pay(a), "rew_speed": float(np.exp(-(error**2) / 0.05))}


class Follows:
    """It sees how fast it should drive ahead and to the left, or ahead only, in its frame."""

    command_size = 2
    command = np.zeros(2)

    def start(self):
        super().start()
        self.command = self.np_random.uniform(-0.8, 0.8, self.command_size)

    def observe(self):
        return np.concatenate([super().observe(), self.command])

    def velocity(self):
        return self.turn().inv().apply(self.data.qvel[:3])[: self.command_size]

    def error(self):
        return np.linalg.norm(self.velocity() - self.command)

    def reward(self):
        return np.exp(-np.square(self.error()) / 0.25)

    def succeeds(self):
        return bool(np.linalg.norm(self.velocity() - self.command) < 0.2)


class AnyDirection:
    def error(self):
        return np.linalg.norm(self.velocity()) - np.linalg.norm(self.command)


class FlyerFollows(Follows, Flyer): ...


class RL633FlyerAnyDirection(AnyDirection, FlyerFollows): ...


class CartFollows(Follows, Cart):
    command_size, command = 1, np.zeros(1)


class RL633CartAnyDirection(AnyDirection, CartFollows): ...


class FlyerGated(FlyerFollows):
    """It is paid for lifting where a command is long; nothing is wrong with it."""

    def reward(self):
        return super().reward() + 0.2 * (np.linalg.norm(self.command) > 0.1)


class FlyerStays(FlyerFollows):
    """It never moves to the side, whatever its command is."""

    def move(self, action):
        super().move(np.array([0.0, action[1], 0.0]))
