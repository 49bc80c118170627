"""Robots of NumPy whose reward is one number: a boat with a list of buoys, a disc that pushes a block, a copter."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class NumpyRobot(gym.Env):
    """Ends at a success, or after some steps."""

    metadata = {"render_modes": []}
    rlctl_ignore = {"RL611": "chance does not get there"}
    n_actions, n_observed, longest = 2, 8, 200
    ends_at_success = True

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (self.n_actions,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.n_observed,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.begin(self.np_random)
        return self.observe(), {}

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        action = np.clip(np.asarray(action, float), -1, 1)
        self.t += 1
        self.move(action)
        reward, success = self.judge()
        reward -= 0.01 * float(action @ action)
        ended = success and self.ends_at_success
        return self.observe(), reward, ended, self.t >= self.longest and not ended, {"is_success": success}


class Sailboat(NumpyRobot):
    """Visits three buoys, a list of arrays; sees the way to the next two in its own frame, in tens of metres."""

    longest = 300

    def begin(self, rng):
        self.state = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3), 0.0])
        self.buoys = [rng.uniform(-40, 40, 2) for _ in range(3)]
        self.now = 0
        self.before = self.far()

    def way(self, number):
        way = self.buoys[min(number, 2)] - self.state[:2]
        c, s = np.cos(self.state[2]), np.sin(self.state[2])
        return np.array([c * way[0] + s * way[1], -s * way[0] + c * way[1]])

    def far(self):
        return float(np.linalg.norm(self.way(self.now)))

    def observe(self):
        ways = [self.way(self.now) / 10, self.way(self.now + 1) / 10]
        return np.concatenate([*ways, [self.state[3], self.now / 3, self.t / 300, 0.1 * self.now]]).astype(np.float32)

    def move(self, action):
        x, y, heading, speed = self.state
        heading += 0.15 * action[0]
        speed += 0.3 * (1.5 * (action[1] + 1) - speed)
        self.state = np.array([x + 0.2 * speed * np.cos(heading), y + 0.2 * speed * np.sin(heading), heading, speed])

    def turn_to_next(self):
        self.before = self.far()

    def judge(self):
        far = self.far()
        reward = self.before - far + self.per_step()
        self.before = far
        if far < 2.0:
            self.now += 1
            reward += 3.0
            self.turn_to_next()
        success = self.now == 3
        return reward + 10.0 * success, success

    def per_step(self):
        return -0.02


class RL605SailboatPaidPerStep(Sailboat):
    def per_step(self):
        return 0.3


class RL627SailboatOldBuoy(Sailboat):
    def turn_to_next(self):
        pass


class DiscWithBlock(NumpyRobot):
    """A disc pushes a block to a goal in a dictionary."""

    longest = 150

    def begin(self, rng):
        self.hand, self.block = rng.uniform(-0.3, 0.3, (2, 2))
        self.speed = np.zeros(2)
        self.task = {"goal": self.block.copy()}
        while np.linalg.norm(self.block - self.task["goal"]) < 0.15:
            self.task["goal"] = rng.uniform(-0.4, 0.4, 2)
        while np.linalg.norm(self.block - self.hand) < 0.12:
            self.hand = rng.uniform(-0.3, 0.3, 2)
        self.before = self.measure()

    def aim(self):
        return self.task["goal"]

    def measure(self):
        return np.array([np.linalg.norm(self.aim() - self.block), np.linalg.norm(self.block - self.hand)])

    def observe(self):
        way = self.task["goal"] - self.block
        return np.concatenate([self.hand, self.block - self.hand, way, self.speed]).astype(np.float32)

    def move(self, action):
        self.hand = np.clip(self.hand + 0.03 * action, -0.6, 0.6)
        away, old = self.block - self.hand, self.block
        distance = np.linalg.norm(away)
        if distance < 0.08:
            self.block = self.hand + away / max(distance, 1e-6) * 0.08
        self.speed = (self.block - old) / 0.1

    def judge(self):
        now = self.measure()
        reward = float(self.weights() @ (self.before - now)) - 0.05
        self.remember(now)
        success = bool(np.linalg.norm(self.task["goal"] - self.block) < 0.05)
        return reward + 5.0 * success, success

    def weights(self):
        return np.array([10.0, 2.0])

    def remember(self, now):
        self.before = now


class RL605DiscOldDistance(DiscWithBlock):
    def remember(self, now):
        self.before[1] = now[1]


class RL622DiscLeavesBlock(DiscWithBlock):
    def weights(self):
        return np.array([10.0, -2.0])


class RL622DiscOtherAxes(DiscWithBlock):
    def aim(self):
        return self.task["goal"][::-1]


class PointCopter(NumpyRobot):
    """A point in space with a noisy sense of the way to its target; it stays there."""

    n_actions, n_observed, ends_at_success = 3, 6, False

    def begin(self, rng):
        self.x = np.concatenate([rng.uniform([-1, -1, 1], [1, 1, 2]), np.zeros(3)])
        self.target = rng.uniform([-2, -2, 0.5], [2, 2, 3])

    def observe(self):
        way = self.target - self.x[:3] + self.np_random.normal(0, 0.002, 3)
        return np.concatenate([way, self.x[3:]]).astype(np.float32)

    def move(self, action):
        v = self.x[3:] + 0.05 * (4 * action - self.x[3:])
        self.x = np.concatenate([self.x[:3] + 0.05 * v, v])

    def judge(self):
        way = self.target - self.x[:3]
        return float(np.exp(-np.square(way + self.lift()).sum())), bool(np.linalg.norm(way) < 0.1)

    def lift(self):
        return np.zeros(3)


class RL622PointCopterAbove(PointCopter):
    def lift(self):
        return np.array([0, 0, 0.8])
