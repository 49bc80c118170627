"""Robots that replace the value of the last step before they have taken what has changed since, next to their twins:
NumPy and MuJoCo."""

from collections import deque

import mujoco
import numpy as np
from robots import Robot

DT = 0.1  # [s]
XML = """
<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody><body>
<joint name="x" type="slide" axis="1 0 0" damping="1"/>
<joint name="y" type="slide" axis="0 1 0" damping="1"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-1 1"/><motor joint="y" ctrlrange="-1 1"/></actuator></mujoco>
"""


class Sled(Robot):
    """It is to glide to a stake, and sees its velocity as a difference of places."""

    def size(self):
        return 6

    def start(self):
        self.place, self.pushed = self.np_random.uniform(-1, 1, 2), np.zeros(2)
        self.stake = self.np_random.uniform(-1, 1, 2)
        self.velocity = np.zeros(2)
        self.begin()

    def begin(self):
        self.last_place = self.place.copy()

    def glide(self, action):
        self.pushed = 0.8 * self.pushed + 0.3 * action
        self.place = self.place + DT * self.pushed

    def move(self, action):
        self.glide(action)
        self.measure()

    def measure(self):
        self.velocity = (self.place - self.last_place) / DT
        self.last_place = self.place.copy()

    def observe(self):
        return np.concatenate([self.place, self.stake, self.velocity]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm(self.place - self.stake))

    def is_success(self):
        return self.distance() < 0.1

    def reward(self):
        return -self.distance()


class SledRefreshesFirst(Sled):
    def measure(self):
        self.last_place = self.place.copy()
        self.velocity = (self.place - self.last_place) / DT


class SledInPlace(Sled):
    """It writes into its arrays."""

    def begin(self):
        self.memory = {"place": np.array(self.place)}

    def glide(self, action):
        self.pushed = 0.8 * self.pushed + 0.3 * action
        self.memory["place"][:] = self.place
        self.place += DT * self.pushed

    def measure(self):
        self.velocity = np.subtract(self.place, self.memory["place"]) / DT


class SledAliases(SledInPlace):
    def glide(self, action):
        self.pushed = 0.8 * self.pushed + 0.3 * action
        self.memory["place"] = self.place
        self.place += DT * self.pushed


class SledOfHistory(Sled):
    """It keeps its last places."""

    def begin(self):
        self.history = deque([self.place.copy()] * 3, maxlen=3)

    def measure(self):
        self.history.append(self.place.copy())
        self.velocity = (self.place - self.history[-2]) / DT


class SledReadsTheNewest(SledOfHistory):
    def measure(self):
        self.history.append(self.place.copy())
        self.velocity = (self.place - self.history[-1]) / DT


class SledInOneMethod(Sled):
    """It keeps the place before the step in a local variable."""

    def move(self, action):
        before = self.place
        self.glide(action)
        self.velocity = (self.place - before) / DT


class SledKeepsItAfterwards(SledInOneMethod):
    def move(self, action):
        self.glide(action)
        before = self.place
        self.velocity = (self.place - before) / DT


def rate(new, old):
    return (new - old) / DT


class SledOfRates(Sled):
    """One function takes its rates."""

    def begin(self):
        super().begin()
        self.past = (self.place, self.pushed)

    def measure(self):
        self.velocity = rate(self.place, self.past[0]) + 0.1 * rate(self.pushed, self.past[1])
        self.past = (self.place, self.pushed)


class SledOfNoRates(SledOfRates):
    def measure(self):
        self.past = (self.place, self.pushed)
        super().measure()


class SledOfLengths(Sled):
    """It sees how fast it is."""

    def measure(self):
        self.velocity = np.repeat(np.linalg.norm(rate(new=self.place, old=self.last_place)), 2)
        self.last_place = self.place.copy()


class SledOfGains(Sled):
    """It is paid for what it comes nearer."""

    def begin(self):
        super().begin()
        self.seen = {"distance": self.distance()}

    def reward(self):
        now = self.distance()
        gained = self.seen["distance"] - now
        self.seen["distance"] = now
        return 10 * gained


class SledGainsNothing(SledOfGains):
    def reward(self):
        now = self.seen["distance"] = self.distance()
        gained = self.seen["distance"] - now
        return 10 * gained - 0.01


class Float(Robot):
    """MuJoCo moves it, and it sees a filtered velocity."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        super().__init__()

    def size(self):
        return 6

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-1, 1, 2)
        self.mark = self.np_random.uniform(-1, 1, 2)
        self.last_q, self.smooth = self.data.qpos.copy(), np.zeros(2)

    def rate(self):
        return (self.data.qpos - self.last_q) / DT

    def filtered(self):
        return self.smooth + 0.3 * (self.rate() - self.smooth)

    def keep(self):
        self.smooth = self.filtered()
        self.last_q = self.data.qpos.copy()

    def move(self, action):
        self.keep()
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=5)

    def observe(self):
        return np.concatenate([self.data.qpos, self.mark, self.filtered()]).astype(np.float32)

    def is_success(self):
        return bool(np.linalg.norm(self.data.qpos - self.mark) < 0.1)

    def reward(self):
        return -float(np.linalg.norm(self.data.qpos - self.mark)) - 0.1 * float(np.square(self.filtered()).sum())


class RL131FloatFiltersNothing(Float):
    def keep(self):
        self.last_q = self.data.qpos.copy()
        self.smooth = self.filtered()


class FloatKeepsAView(Float):
    def keep(self):
        self.smooth = self.filtered()
        self.last_q = self.data.qpos


class FloatShowsTwice(Float):
    """It reads the velocity once more after it has gone on, for its own log."""

    def keep(self):
        super().keep()
        self.logged = np.abs(self.rate()).max()
