"""Robots whose rewards jump: with an error that is not wrapped, or because a command is drawn again."""

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from mujoco_robots import MujocoRobot


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Buggy(gymnasium.Env):
    """It sees the way to a goal in its own frame, is paid for facing it, and its heading shows nowhere else."""

    dt, limit = 0.1, 120

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.speed, self.turning = 0, 0.0, 0.0
        self.place, self.heading = np.zeros(2), self.np_random.uniform(-np.pi, np.pi)
        direction = self.np_random.uniform(-np.pi, np.pi)
        self.goal = self.np_random.uniform(2, 4) * np.array([np.cos(direction), np.sin(direction)])
        return self.observe(), {}

    def step(self, action):
        action = np.clip(np.nan_to_num(action), -1.0, 1.0).astype(float)
        self.steps += 1
        self.speed += (0.5 * action[0] - self.speed) * self.dt
        self.turning += (4.0 * action[1] - self.turning) * self.dt
        self.heading = wrap(self.heading + self.turning * self.dt)
        self.place = self.place + self.speed * self.dt * np.array([np.cos(self.heading), np.sin(self.heading)])
        return self.observe(), float(0.2 * self.speed - abs(self.error())), False, self.steps >= self.limit, {}

    def observe(self):
        x, y = self.goal - self.place
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        return np.array([x * cosine + y * sine, y * cosine - x * sine, self.speed, self.turning], np.float32)

    def away(self):
        x, y = self.goal - self.place
        return np.arctan2(y, x) - self.heading

    def error(self):
        return wrap(self.away())


class RL618BuggyTurnsRound(Buggy):
    def error(self):
        return self.away()


BALANCER = """
<mujoco><option timestep="0.005" integrator="implicitfast"/>
<default><geom friction="1 0.01 0.001"/><joint damping="0.02" armature="0.002"/></default>
<worldbody><geom type="plane" size="40 40 0.1"/>
<body name="chassis" pos="0 0 0.1"><freejoint/>
  <geom type="box" size="0.05 0.12 0.03" mass="2"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.6"/>
  <geom type="sphere" pos="0 0 0.5" size="0.06" mass="1.2"/>
  <body name="left" pos="0 0.16 0"><joint name="left" axis="0 1 0"/>
    <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.4"/></body>
  <body name="right" pos="0 -0.16 0"><joint name="right" axis="0 1 0"/>
    <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="0.4"/></body></body></worldbody>
<actuator><motor joint="left" gear="4" ctrlrange="-1 1" ctrllimited="true"/>
<motor joint="right" gear="4" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>
"""


class Balancer(MujocoRobot):
    """It balances on two wheels, and follows commands of a speed forwards and a yaw rate, which are drawn again."""

    rlctl_ignore = {
        "RL506": "a wrapper limits its episodes",
        "RL704": "no NaN comes from its controller",
        "RL609": "it follows a velocity without end",
        "RL102": "as MuJoCo has it",
    }
    xml, joints, frames = BALANCER, 2, 4
    last_action, command, count = np.zeros(2), np.zeros(2), 0

    def angles(self):
        w, x, y, z = self.data.qpos[3:7]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return yaw, np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))

    def speed(self):
        yaw, _ = self.angles()
        return self.data.qvel[0] * np.cos(yaw) + self.data.qvel[1] * np.sin(yaw)

    def draw(self):
        self.command = self.np_random.uniform([-1.0, -1.5], [1.0, 1.5])

    def start(self):
        self.put_back()
        pitch = self.np_random.uniform(-0.05, 0.05)
        yaw = self.np_random.uniform(-np.pi, np.pi)
        cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
        self.data.qpos[3:7] = [cy * cp, -sy * sp, cy * sp, sy * cp]
        self.data.qvel[:] += self.np_random.uniform(-0.05, 0.05, self.model.nv)
        self.draw()

    def put_back(self):
        self.last_action, self.count = np.zeros(2), 0

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.count += 1
        _, pitch = self.angles()
        wrong = self.command - [self.speed(), self.data.qvel[5]]
        reward = np.exp(-(wrong[0] ** 2) / 0.25) + 0.5 * np.exp(-(wrong[1] ** 2) / 0.25) + 0.5 * np.cos(pitch)
        reward -= 0.05 * np.sum((action - self.last_action) ** 2)
        terminated = bool(abs(pitch) > 0.8 or self.data.qpos[2] < 0.05)
        self.last_action = action.copy()
        if self.count % 200 == 0:
            self.draw()
        return self.observe(), reward, terminated, False, self.info()

    def info(self):
        return {"pitch": self.angles()[1], "command": self.command.copy()}

    def observe(self):
        _, pitch = self.angles()
        rates = self.data.qvel[4], self.speed(), self.data.qvel[5]
        return np.concatenate([[pitch, *rates], self.data.qvel[6:8], self.last_action, self.command])


class BalancerCountsOn(Balancer):
    """A reset leaves the last action, and the count of steps after which a command is drawn again."""

    def put_back(self): ...


class RL105BalancerSharesItsWheels(Balancer):
    def info(self):
        return {"pitch": self.angles()[1], "wheels": self.data.qvel[6:8]}


class RL123BalancerSeesX(Balancer):
    """A reset draws small velocities, which turn with it."""

    def speed(self):
        return self.data.qvel[0]


class RL124BalancerTurnsBack(Balancer):
    def speed(self):
        yaw, _ = self.angles()
        return self.data.qvel[0] * np.cos(yaw) - self.data.qvel[1] * np.sin(yaw)
