"""Robots that follow a commanded velocity and observe theirs in another frame than the reward, next to their twins."""

import numpy as np
from broken_substeps import Airship
from broken_turned import Flyer, Puck


class Commanded:
    """It is paid for moving at a commanded velocity in its own frame, and sees both, and its heading."""

    command = np.zeros(2)

    def draw(self):
        self.command = self.np_random.uniform(-0.6, 0.6, 2)

    def pay(self, velocity):
        return float(np.exp(-np.square(velocity - self.command).sum() / 0.2))


class FlyerIsSent(Commanded, Flyer):
    """In MuJoCo; the term is in info, under one name."""

    def start(self):
        super().start()
        self.draw()

    def inside(self):
        return self.turn().inv().apply(self.data.qvel[:3])[:2]

    def seen(self):
        return self.inside()

    def observe(self):
        yaw = self.yaw()
        return np.array([np.cos(yaw), np.sin(yaw), *self.seen(), self.data.qvel[5], *self.command])

    def reward(self):
        return 2.0 * self.pay(self.inside())

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {**info, "reward_tracking": 2.0 * self.pay(self.inside())}


class RL128FlyerIsSentNorth(FlyerIsSent):
    rlctl_ignore = {**Flyer.rlctl_ignore, "RL701": "how high it flies is neither seen nor paid"}

    def seen(self):
        return self.data.qvel[:2]


class PuckIsSent(Commanded, Puck):
    """In PyBullet; nothing but the reward says what is paid."""

    def size(self):
        return 7

    def put_back(self):
        super().put_back()
        self.draw()

    def inside(self):
        turn, velocity, _ = self.look()
        return turn.inv().apply(velocity)[:2]

    def seen(self):
        return self.inside()

    def observe(self):
        turn, _, turning = self.look()
        ahead = turn.apply([1.0, 0.0, 0.0])[:2]
        return np.array([*ahead, *self.seen(), turning[2], *self.command], np.float32)

    def reward(self):
        return -float(np.linalg.norm(self.inside() - self.command))


class RL128PuckIsSentNorth(PuckIsSent):
    def seen(self):
        return self.look()[1][:2]


class AirshipIsSent(Commanded, Airship):
    """Without an engine, in a dictionary, without noise."""

    rlctl_ignore = {"RL611": "it follows a velocity without end"}

    def start(self):
        super().start()
        self.draw()

    def observe(self):
        parts = super().observe()
        parts = {name: parts[name] for name in ("heading", "yaw_rate", "time_left")}
        return {**parts, "velocity": self.seen_velocity()[:2].astype(np.float32), "command": self.command.astype("f")}

    def distance(self):
        return 1.0

    def reward(self, action):
        return self.pay(self.turn(self.velocity, -self.yaw)[:2])


class RL128AirshipIsSentTwice(AirshipIsSent):
    rlctl_ignore = {
        **AirshipIsSent.rlctl_ignore,
        **dict.fromkeys(["RL124", "RL129"], "without the command, the velocity alone shows it as well"),
    }

    def seen_velocity(self):
        return self.turn(self.velocity, self.yaw)
