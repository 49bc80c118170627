"""A base in MuJoCo whose goals are a list of arrays; terms of its reward are in `terms` of info."""

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

XML = """
<mujoco><option timestep="0.004"/><worldbody><geom type="plane" size="9 9 1"/>
<body name="base" pos="0 0 .1"><joint name="x" type="slide" axis="1 0 0" damping="2"/>
<joint name="y" type="slide" axis="0 1 0" damping="2"/>
<joint name="yaw" type="hinge" axis="0 0 1" damping=".3"/>
<geom type="box" size=".15 .1 .05" mass="4"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-90 90"/><motor joint="y" ctrlrange="-90 90"/>
<motor joint="yaw" ctrlrange="-9 9"/></actuator></mujoco>
"""
RATE = 25
FRAMES = 10


class WayPoints(gym.Env):
    """A base on three joints that visits places one after the other."""

    metadata = {"render_modes": [], "render_fps": RATE}
    rlctl_ignore = {"RL611": "chance does not visit all places"}

    def __init__(self):
        self.m = mujoco.MjModel.from_xml_string(XML)
        self.d = mujoco.MjData(self.m)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        sizes = {"body": 5, "way": 2, "left": 1}
        boxes = {name: spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
        self.observation_space = spaces.Dict(boxes)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.m, self.d)
        self.d.qpos[:] = [*self.np_random.uniform(-0.5, 0.5, 2), self.np_random.uniform(-3, 3)]
        mujoco.mj_forward(self.m, self.d)
        self.stops = [self.np_random.uniform(-2, 2, 2) for _ in range(3)]
        self.at = 0
        self.old_yaw = self.d.qpos[2]
        self.rate = 0.0
        self.n = 0
        self.gap = self.dist()
        return self.obs(), {}

    def way(self):
        return self.stops[self.at] - self.d.qpos[:2]

    def dist(self):
        return float(np.linalg.norm(self.way()))

    def turned(self, v):
        c, s = np.cos(self.d.qpos[2]), np.sin(self.d.qpos[2])
        return np.array([c * v[0] + s * v[1], -s * v[0] + c * v[1]])

    def turned_way(self, v):
        return self.turned(v)

    def bearing(self):
        w = self.way()
        return (np.arctan2(w[1], w[0]) - self.d.qpos[2] + np.pi) % (2 * np.pi) - np.pi

    def push(self, a):
        for _ in range(FRAMES):
            v = self.turned(self.d.qvel[:2])
            f = 40 * (a[0] - v[0])
            c, s = np.cos(self.d.qpos[2]), np.sin(self.d.qpos[2])
            side = -40 * v[1]
            self.d.ctrl[:] = [c * f - s * side, s * f + c * side, 2 * a[1] - self.d.qvel[2]]
            mujoco.mj_step(self.m, self.d)

    def renew(self):
        self.gap = self.dist()

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(action, float), -1, 1)
        self.push(a)
        self.n += 1
        self.rate = (self.d.qpos[2] - self.old_yaw) * RATE
        self.old_yaw = self.d.qpos[2]
        d = self.dist()
        effort = float(np.sum(a**2))
        terms = {"progress": 2 * (self.gap - d), "bearing": -0.02 * abs(self.bearing()), "effort": -0.01 * effort}
        terms["stop"] = 0.0
        self.gap = d
        done = False
        if d < 0.2:
            terms["stop"] = 3.0
            if self.at == 2:
                done = True
            else:
                self.at += 1
                self.renew()
        return self.obs(), float(sum(terms.values())), done, self.n >= 300, {"terms": terms, "is_success": done}

    def obs(self):
        v = self.turned(self.d.qvel[:2])
        c, s = np.cos(self.d.qpos[2]), np.sin(self.d.qpos[2])
        body, left = np.array([*v, self.rate, c, s], np.float32), np.array([self.at / 3], np.float32)
        return {"body": body, "way": self.turned_way(self.way()).astype(np.float32), "left": left}


class RL125WayPointsTurned(WayPoints):
    def turned_way(self, v):
        c, s = np.cos(self.d.qpos[2]), np.sin(self.d.qpos[2])
        return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


class RL618WayPointsLookRound(WayPoints):
    def bearing(self):
        w = self.way()
        return np.arctan2(w[1], w[0]) - self.d.qpos[2]


class RL627WayPointsOldGoal(WayPoints):
    def renew(self):
        pass
