"""Robots that fall before their time is up, and what shows only while they are held."""

import numpy as np
from mujoco_robots import MujocoHopper
from robots import Crawler


class Follower:
    """What both share: a speed that is drawn every few steps, the order of a step, and a time limit."""

    rlctl_ignore = dict.fromkeys(["RL110", "RL506", "RL604"], "it falls early, and is paid badly")
    limit = 150  # [steps]
    every = 20  # [steps]
    wanted = 0.0

    def start(self):
        super().start()
        self.wanted = self.np_random.uniform(-1, 1)

    def observe(self):
        return np.append(super().observe(), np.float32(self.wanted))

    def reward(self):
        return -abs(self.speed() - self.wanted)

    def follow(self):
        if self.steps % self.every == 0:
            self.wanted = self.np_random.uniform(-1, 1)

    def look_and_judge(self):
        reward = self.reward()
        self.follow()
        return self.observe().astype(np.float32), float(reward)

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError(f"action {action} is not finite")
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))
        return *self.look_and_judge(), *self.flags(), {"is_success": abs(self.speed() - self.wanted) < 0.05}

    def flags(self):
        return self.has_fallen(), self.steps >= self.limit


class FallingHopper(Follower, MujocoHopper):
    """Drops onto its legs, which is too much for it."""

    def start(self):
        super().start()
        self.data.qpos[2] = 0.8

    def speed(self):
        return self.ahead()

    def has_fallen(self):
        return bool(self.data.qpos[2] < 0.6)


class FallingCrawler(Follower, Crawler):
    """May not turn."""

    def speed(self):
        return self.forward()

    def size(self):
        return super().size() + 1

    def has_fallen(self):
        return bool(np.abs(self.angles()).max() > 0.1)


class RL122HopperSeesLate(FallingHopper):
    """Looks, draws the next speed, and is rewarded for that one."""

    def look_and_judge(self):
        observation = self.observe().astype(np.float32)
        self.follow()
        return observation, float(self.reward())


class RL501HopperTimeIsUp(FallingHopper):
    def flags(self):
        return self.has_fallen() or self.steps >= self.limit, False


class RL122CrawlerSeesLate(FallingCrawler):
    """Looks, draws the next speed, and is rewarded for that one."""

    def look_and_judge(self):
        observation = self.observe().astype(np.float32)
        self.follow()
        return observation, float(self.reward())


class RL501CrawlerTimeIsUp(FallingCrawler):
    def flags(self):
        return self.has_fallen() or self.steps >= self.limit, False


class RL501HopperStandsStill(FallingHopper):
    """Fails where it has moved by less than 0.1 m in 50 steps."""

    def start(self):
        super().start()
        self.left, self.left_at = np.zeros(2), 0

    def flags(self):
        place = self.data.qpos[:2].copy()
        if np.linalg.norm(place - self.left) > 0.1:
            self.left, self.left_at = place, self.steps
        return self.has_fallen() or self.steps - self.left_at >= 50, False
