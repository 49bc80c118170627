"""Robots whose reward has a wrong sign, index or bonus in one expression, written in several ways, next to twins."""

import gymnasium as gym
import mujoco
import numpy as np
from broken_sweeps import Rover
from gymnasium import spaces

DT, LONGEST = 0.05, 200
WEIGHTS = {"track_speed": 1.0, "track_turn": 0.5, "drive": -0.02}


class Skid(gym.Env):
    """It drives on a plane as it is commanded: ahead, and how fast it turns."""

    rlctl_ignore = {"RL609": "it follows a velocity without end"}

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-10, 10, (7,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.velocity = self.np_random.normal(0, 0.1, 2)
        self.omega = np.zeros(3)
        self.state = {"cmd": self.np_random.uniform([-0.8, -1.2], [0.8, 1.2]), "motors": np.zeros(2)}
        self.steps = 0
        return self.observe(), {}

    def observe(self):
        noise = self.np_random.normal(0, 0.02, 5)
        seen = np.concatenate([self.velocity, self.omega]) + noise
        return np.concatenate([seen, self.state["cmd"]]).astype(np.float32)

    def drive(self, action):
        self.state["motors"] += 0.5 * (action - self.state["motors"])
        left, right = self.state["motors"]
        self.velocity += DT * (3 * np.array([left + right, 0.4 * left]) - 2 * self.velocity)
        self.omega += DT * (np.array([left, 0.3 * right, 6 * (right - left)]) - 2 * self.omega)

    def pay_speed(self):
        missing = self.state["cmd"][0] - self.velocity[0]
        return 1 - np.tanh(2 * abs(missing))

    def pay_turn(self):
        turn_error = self.state["cmd"][1] - self.omega[2]
        return np.exp(-np.square(turn_error) / 0.3)

    def cost_drive(self):
        return np.square(self.state["motors"]).mean()

    def step(self, action):
        self.drive(np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1))
        self.steps += 1
        terms = {"track_speed": self.pay_speed(), "track_turn": self.pay_turn(), "drive": self.cost_drive()}
        reward = 0.0
        for name, value in terms.items():
            reward += WEIGHTS[name] * value
        return self.observe(), float(reward), False, self.steps >= LONGEST, {}


class RL634SkidRaces(Skid):
    def pay_speed(self):
        missing = self.state["cmd"][0] - self.velocity[0]
        return 1 - np.tanh(2 * missing)


class RL630SkidSavesInReverse(Skid):
    def cost_drive(self):
        return self.state["motors"].mean()


class RL632SkidTurnsAsItDrives(Skid):
    def pay_turn(self):
        ahead, _ = self.state["cmd"]
        return np.exp(-np.square(ahead - self.omega[2]) / 0.3)


class RL635SkidRolls(Skid):
    def pay_turn(self):
        turn_error = self.state["cmd"][1] - self.omega[0]
        return np.exp(-np.square(turn_error) / 0.3)


class Docker(gym.Env):
    """It flies to a dock with an arm in front; being there ends the episode."""

    def __init__(self):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-10, 10, (6,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = np.zeros(2), np.zeros(2)
        self.dock = self.np_random.uniform(0.3, 0.8, 2) * self.np_random.choice([-1, 1], 2)
        self.last_gap = self.gap()
        self.steps = 0
        return self.observe(), {}

    def observe(self):
        return np.concatenate([self.place, self.speed, self.dock]).astype(np.float32)

    def gap(self):
        return np.linalg.norm(self.dock - self.place)

    def shape(self, gap):
        progress = self.last_gap - gap
        self.last_gap = gap
        return 10 * progress - 0.05

    def near(self, gap):
        return 0.02 * np.exp(-gap / 0.2)

    def step(self, action):
        self.speed += DT * (4 * np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1) - self.speed)
        self.place = np.clip(self.place + DT * self.speed, -2, 2)
        self.steps += 1
        gap = self.gap()
        docked = bool(gap < 0.1)
        reward = self.shape(gap)
        reward += self.near(gap)
        if docked:
            reward = reward + 10.0
        return self.observe(), float(reward), docked, self.steps >= LONGEST, {"is_success": docked}


class RL622DockerFlees(Docker):
    def shape(self, gap):
        change = gap - self.last_gap
        self.last_gap = gap
        return 10 * change - 0.05


class RL622DockerIsNearAtACost(Docker):
    def near(self, gap):
        return -0.3 * np.exp(-gap / 0.2)


class RL620DockerComparesWithItself(Docker):
    def shape(self, gap):
        self.last_gap = gap
        progress = self.last_gap - gap
        return 10 * progress - 0.05


class RL605DockerWaits(Docker):
    rlctl_ignore = {"RL606": "waiting anywhere is paid, too"}

    def shape(self, gap):
        return 0.5 - 0.2 * np.tanh(gap)


class DockerHooks(Docker):
    """Its hook is paid for while it is out, besides the success that ends the episode."""

    bonus = 100.0

    def step(self, action):
        observation, _, _, truncated, _ = super().step(action)
        gap = self.gap()
        hooked = bool(action[0] > 0.2)
        docked = bool(gap < 0.02)
        reward = -0.3 * gap
        if hooked:
            reward += 0.4
        if docked:
            reward += self.bonus
        return observation, float(reward), docked, truncated, {"is_success": docked}


class RL605DockerHooksForever(DockerHooks):
    rlctl_ignore = {"RL611": "a hook that is held ends nothing"}

    bonus = 2.0


class DockerOpensItsHook(Docker):
    """It is paid for each time its hook comes out."""

    count = 0

    def step(self, action):
        observation, _, _, truncated, _ = super().step(action)
        gap, known = self.gap(), self.count
        self.count = int(action[0] > 0.97)
        docked = bool(gap < 0.02)
        reward = -0.3 * gap + 1.5 * (self.count - known)
        if docked:
            reward += 5.0
        return observation, float(reward), docked, truncated, {"is_success": docked}


class RoverIsSlow(Rover):
    """Its reward subtracts how fast it slides over the ground."""

    def sliding_speed(self):
        six = np.zeros(6)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, 1, six, 0)
        return np.linalg.norm(six[3:5])

    def pay_speed(self, missing):
        return super().pay_speed(missing) - 0.05 * self.sliding_speed()


class RL640RoverIsUpright(RoverIsSlow):
    def sliding_speed(self):
        six = np.zeros(6)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, 1, six, 0)
        return np.linalg.norm(six[0:2])
