"""A leg of two joints that hops on the spot, in MuJoCo: its motors, its touch sensor, and the time of its foot in the
air; next to its twin."""

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

LEG = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="hip" pos="0 0 0.3">
      <joint name="rail" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.04 0.04 0.03" mass="0.8"/>
      <body name="thigh">
        <joint name="hip" axis="0 1 0" armature="0.005" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.012" mass="0.1" contype="0" conaffinity="0"/>
        <body name="shin" pos="0 0 -0.15">
          <joint name="knee" axis="0 1 0" armature="0.005" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.01" mass="0.05" contype="0" conaffinity="0"/>
          <geom name="foot" type="sphere" pos="0 0 -0.15" size="0.02" mass="0.02" friction="0.2"/>
          SITE
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general joint="hip" gainprm="2" biastype="affine" biasprm="0 -60 -1"/>
    <general joint="knee" gainprm="2" biastype="affine" biasprm="0 -60 -1"/>
  </actuator>
  SENSOR
</mujoco>"""
STANCE, HOLD = np.array([0.6, -1.2]), 30.0  # [rad]; input per position


class Leg(gym.Env):
    """It feels the ground by a touch sensor."""

    rlctl_ignore = {"RL609": "it hops without end"}
    site, sensor = '<site name="foot" pos="0 0 -0.15" size="0.03"/>', '<sensor><touch site="foot"/></sensor>'
    order = (0, 1)

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(LEG.replace("SITE", self.site).replace("SENSOR", self.sensor))
        self.data = mujoco.MjData(self.model)
        sizes = {"joints": 2, "rates": 2, "rail": 2, "foot_contact": 1, "air_time": 1}
        boxes = {name: spaces.Box(-np.inf, np.inf, (size,), np.float32) for name, size in sizes.items()}
        self.action_space, self.observation_space = spaces.Box(-1, 1, (2,), np.float32), spaces.Dict(boxes)

    def touches(self):
        return bool(self.data.sensordata[0] > 0)

    def observe(self):
        data = self.data
        seen = {"joints": data.qpos[1:] - STANCE, "rates": data.qvel[1:], "rail": [data.qpos[0], data.qvel[0]]}
        seen |= {"foot_contact": [self.touches()], "air_time": [self.air_s]}
        return {name: np.array(values, np.float32) for name, values in seen.items()}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[1:] = STANCE + self.np_random.uniform(-0.05, 0.05, 2)
        self.data.ctrl[:] = HOLD * STANCE
        mujoco.mj_forward(self.model, self.data)
        self.air_s, self.steps = 0.0, 0
        return self.observe(), {}

    def land(self):
        """Return what a landing pays, and count on."""
        is_down = self.touches()
        landed = is_down and self.air_s > 0
        paid = self.air_s - 0.1 if landed else 0.0
        self.air_s = 0.0 if is_down else self.air_s + 0.02
        return paid

    def step(self, action):
        action = np.clip(np.nan_to_num(np.asarray(action, float)), -1, 1)
        self.data.ctrl[:] = HOLD * (STANCE + 0.6 * action)[list(self.order)]
        for _ in range(5):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.steps += 1
        terms = {"hop": 2.0 * self.land(), "height": float(self.data.qpos[0]), "effort": -0.01 * float(action @ action)}
        return self.observe(), sum(terms.values()), False, self.steps >= 200, {"reward_terms": terms}


class RL628LegLandsInEveryStep(Leg):
    def land(self):
        self.air_s += 0.02
        return super().land()


class RL811LegOrder(Leg):
    order = (1, 0)


class RL834LegFeelsNothing(Leg):
    site = '<site name="foot" pos="0.06 0 -0.15" size="0.01"/>'


class RL834LegSearches(Leg):
    """It has no sensor, and searches the contacts."""

    site = sensor = ""

    def find_foot(self):
        return self.model.geom("foot").id

    def touches(self):
        return any(self.find_foot() in pair for pair in self.data.contact.geom.tolist())


class RL834LegSearchesTheShin(RL834LegSearches):
    def find_foot(self):
        return self.model.geom("foot").id + 1
