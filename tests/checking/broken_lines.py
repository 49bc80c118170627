"""Robots with a line that turns a vector the wrong way, leaves out an element of the action, or compares the wrong ids;
next to their twins."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

GRAVITY = np.array([0.0, 0.0, -9.81])
LENS = np.array([1.0, 0.0, 0.0])


def box(size):
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


def to_matrix(q):
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Kite(gym.Env):
    """It turns in all directions, keeps its state in a dictionary, and looks at a balloon."""

    rlctl_ignore = {"RL609": "it has no goal"}

    size = 3

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = box(9)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        q = self.np_random.normal(size=4)
        north = self.np_random.normal(size=3)
        self.state = {"q": q / np.linalg.norm(q), "pos": self.np_random.normal(size=3), "omega": np.zeros(3)}
        self.north = north / np.linalg.norm(north)
        self.balloon = self.np_random.normal(size=3) * 5
        self.steps = 0
        return self._get_obs(), {}

    def gravity(self, matrix):
        return matrix.T @ GRAVITY

    def compass(self, matrix):
        return np.dot(matrix.T, self.north)

    def way(self, matrix):
        return (self.balloon - self.state["pos"]) @ matrix

    def sight(self, matrix):
        return matrix @ LENS

    def _get_obs(self):
        matrix = to_matrix(self.state["q"])
        noise = self.np_random.normal(0, 0.02, 9)
        parts = [self.gravity(matrix), self.compass(matrix), self.way(matrix)]
        return (np.concatenate(parts) + noise).astype(np.float32)

    def step(self, action):
        self.state["omega"] += 0.3 * np.clip(np.nan_to_num(action), -1, 1)
        x, y, z = 0.05 * self.state["omega"]
        a, b, c, w = self.state["q"]
        turned = np.array([w * x + b * z - c * y, w * y + c * x - a * z, w * z + a * y - b * x, -a * x - b * y - c * z])
        q = self.state["q"] + turned
        self.state["q"] = q / np.linalg.norm(q)
        self.state["pos"] = self.state["pos"] + self.np_random.normal(0, 0.02, 3)
        self.steps += 1
        to_balloon = self.balloon - self.state["pos"]
        facing = self.sight(to_matrix(self.state["q"])) @ (to_balloon / np.linalg.norm(to_balloon))
        return self._get_obs(), float(facing), False, self.steps >= 60, {}


class KiteDown(Kite):
    def gravity(self, matrix):
        return matrix @ GRAVITY


class RL124KiteNorth(Kite):
    rlctl_ignore = {**Kite.rlctl_ignore, "RL129": "it shows in what is observed, too"}

    def compass(self, matrix):
        return np.dot(matrix, self.north)


class KiteWay(Kite):
    def way(self, matrix):
        to_balloon = self.balloon - self.state["pos"]
        return np.matmul(matrix, to_balloon)


class RL124KiteLens(Kite):
    rlctl_ignore = {**Kite.rlctl_ignore, "RL129": "it shows in what is observed, too"}

    def sight(self, matrix):
        return matrix.T @ LENS


class Barge(gym.Env):
    """It turns in the plane; everything is written out by elements."""

    rlctl_ignore = {"RL609": "it has no goal"}

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = box(6)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.y = self.np_random.uniform(-1, 1, 2)
        self.goal_x, self.goal_y = self.np_random.uniform(-6, 6, 2)
        self.yaw = self.np_random.uniform(-np.pi, np.pi)
        self.ahead = self.aside = self.turning = 0.0
        self.last_action = np.zeros(3)
        self.steps = 0
        return self.observe(), {}

    def turn(self, v):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * v[0] + s * v[1], c * v[1] - s * v[0]])

    def turn_way(self, v):
        return self.turn(v)

    def observe(self):
        goal, pos = np.array([self.goal_x, self.goal_y]), np.array([self.x, self.y])
        way = self.turn_way(goal - pos)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        velocity = self.turn(np.array([c * self.ahead - s * self.aside, s * self.ahead + c * self.aside]))
        noise = self.np_random.normal(0, 0.02, 6)
        return (np.array([*way, *velocity, np.sin(self.yaw), np.cos(self.yaw)]) + noise).astype(np.float32)

    def drive(self, action):
        return 0.5 * action[0], 0.3 * action[1], 0.2 * action[2]

    def step(self, action):
        action = np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1)
        thrust, side, torque = self.read(action)
        self.ahead += 0.1 * (thrust - self.ahead)
        self.aside += 0.1 * (side - self.aside)
        self.turning += 0.1 * (torque - self.turning)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        self.x += 0.1 * (c * self.ahead - s * self.aside)
        self.y += 0.1 * (s * self.ahead + c * self.aside)
        self.yaw += self.turning
        self.steps += 1
        reward = -np.hypot(self.goal_x - self.x, self.goal_y - self.y) - 0.1 * np.sum((action - self.last_action) ** 2)
        self.last_action = action
        return self.observe(), float(reward), False, self.steps >= 60, {}

    def read(self, action):
        return self.act(action)

    def act(self, action):
        return action[0], action[1], 0.5 * action[2]


class BargeWay(Barge):
    def turn_way(self, v):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


class RL701BargeCopied(Barge):
    def act(self, action):
        thrust = action[0]
        side = action[1]
        return thrust, side, 0.5 * action[1]


class Skiff(Barge):
    """It does not observe its heading: all vectors are in its own frame."""

    def __init__(self):
        super().__init__()
        self.observation_space = box(4)

    def observe(self):
        way = self.turn_way(np.array([self.goal_x - self.x, self.goal_y - self.y]))
        velocity = self.turn(self.measure_velocity())
        observation = np.zeros(4)
        observation[:2] = way
        observation[2:] = velocity
        return (observation + self.np_random.normal(0, 0.02, 4)).astype(np.float32)

    def measure_velocity(self):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * self.ahead - s * self.aside, s * self.ahead + c * self.aside])


class RL129SkiffWayInTheWorld(Skiff):
    def observe(self):
        pos = np.array([self.x, self.y])
        way = np.array([self.goal_x, self.goal_y]) - pos
        velocity = self.turn(self.measure_velocity())
        observation = np.concatenate((way, velocity))
        return (observation + self.np_random.normal(0, 0.02, 4)).astype(np.float32)
