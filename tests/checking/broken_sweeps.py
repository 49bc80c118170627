"""Robots that follow a speed and a turn rate, whose rewards have no best command, or the wrong one, next to twins."""

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

PLACES = {"fl": (0.2, 0.18), "bl": (-0.2, 0.18), "fr": (0.2, -0.18), "br": (-0.2, -0.18)}
WHEELS = "".join(
    f'<body pos="{x} {y} -0.05"><joint name="{name}" axis="0 1 0" damping="0.02" armature="0.005"/>'
    '<geom type="cylinder" size="0.08 0.03" euler="90 0 0" mass="0.4"/></body>'
    for name, (x, y) in PLACES.items()
)
ROVER = f"""
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="50 50 1"/>
    <body pos="0 0 0.2">
      <freejoint/><geom type="box" size="0.25 0.12 0.05" mass="5" contype="0" conaffinity="0"/>{WHEELS}
    </body>
  </worldbody>
  <actuator>{"".join(f'<velocity joint="{name}" kv="2"/>' for name in PLACES)}</actuator>
</mujoco>"""


class Rover(gym.Env):
    """In MuJoCo, with a flat observation and noise; nothing but the reward says what is paid."""

    rlctl_ignore = {"RL609": "it follows a velocity without end"}

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(ROVER)
        self.data = mujoco.MjData(self.model)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (11,), np.float32)

    def turn(self):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, self.data.qpos[3:7])
        return matrix.reshape(3, 3)

    def velocity(self):
        return self.turn().T @ self.data.qvel[:3]

    def observe(self):
        seen = np.concatenate([self.turn()[2], self.velocity(), self.data.qvel[3:6]])
        return np.append(seen + self.np_random.normal(0, 0.01, 9), self.command).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        half = self.np_random.uniform(-1.5, 1.5)
        self.data.qpos[2:7] = 0.13, np.cos(half), 0, 0, np.sin(half)
        mujoco.mj_forward(self.model, self.data)
        self.command = self.np_random.uniform([-0.8, -1.2], [0.8, 1.2])
        self.steps = 0
        return self.observe(), {}

    def pay_speed(self, missing):
        return np.exp(-(missing**2) / 0.2)

    def rate(self):
        return self.data.qvel[5]

    def step(self, action):
        ahead, turn = 8 * np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1)
        self.data.ctrl[:] = np.repeat([ahead - turn, ahead + turn], 2)
        for _ in range(5):
            mujoco.mj_step(self.model, self.data)
        self.steps += 1
        turning = np.exp(-((self.command[1] - self.rate()) ** 2) / 0.3)
        reward = self.pay_speed(self.command[0] - self.velocity()[0]) + 0.5 * turning
        return self.observe(), float(reward), False, self.steps >= 300, {}


class RL634RoverRaces(Rover):
    def pay_speed(self, missing):
        return np.exp(-missing / 0.5)


class RoverIsCapped(Rover):
    """More than the command is worth no more."""

    def pay_speed(self, missing):
        return -max(missing, 0.0)


class RL635RoverTurnsAboutItsSide(Rover):
    def rate(self):
        return self.data.qvel[4]


class RL635RoverTurnsBack(Rover):
    def rate(self):
        return -self.data.qvel[5]


class Boat(gym.Env):
    """Without an engine; in a dictionary, with terms."""

    rlctl_ignore = {"RL609": "it follows a velocity without end"}

    def __init__(self):
        sizes = {"velocity": 2, "yaw_rate": 1, "command": 2}
        boxes = {name: spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
        self.action_space, self.observation_space = spaces.Box(-1, 1, (2,), np.float32), spaces.Dict(boxes)

    def observe(self):
        seen = {"velocity": self.velocity, "yaw_rate": [self.rate], "command": self.command}
        return {name: np.array(values, np.float32) for name, values in seen.items()}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.velocity, self.rate = self.np_random.uniform(-0.2, 0.2, 2), self.np_random.uniform(-0.1, 0.1)
        self.command = self.np_random.uniform([0.3, -0.6], [1.2, 0.6])
        self.steps = 0
        return self.observe(), {}

    def terms(self):
        speed, rate = self.command - [self.velocity[0], self.rate]
        return {"speed": 1.0 - abs(speed), "turn": -0.5 * rate**2}

    def step(self, action):
        thrust, rudder = np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1)
        along, aside = self.velocity
        self.velocity = self.velocity + 0.1 * np.array(
            [2 * thrust - 1.2 * along + self.rate * aside, -2.5 * aside - self.rate * along]
        )
        self.rate += 0.1 * (1.5 * rudder * (0.3 + abs(along)) - 1.5 * self.rate)
        self.steps += 1
        terms = self.terms()
        return self.observe(), float(sum(terms.values())), False, self.steps >= 200, {"reward_terms": terms}


class RL634BoatFleesTheCommand(Boat):
    rlctl_ignore = {**Boat.rlctl_ignore, "RL622": "the same sum once more"}

    def terms(self):
        return {**super().terms(), "turn": 0.5 * (self.command[1] - self.rate) ** 2}


class RL635BoatTurnsBack(Boat):
    def terms(self):
        return {**super().terms(), "turn": -0.5 * (self.command[1] + self.rate) ** 2}


class BoatGoesAlong(Boat):
    """It is paid for its velocity along the command, which has no best value."""

    def terms(self):
        return {"along": self.command[0] * self.velocity[0] + self.command[1] * self.rate}
