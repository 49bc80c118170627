"""Robots that compare the ids of contacts with the wrong ones; next to their twins."""

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces

MODEL = """<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1"/>
    <body name="trunk" pos="0 0 0.3"><freejoint/>
      <geom name="hull" type="box" size="0.2 0.1 0.05" mass="2"/>
      <body name="left" pos="0 0.1 -0.05"><joint name="left" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.02" mass="0.1"/>
        <geom name="left_foot" type="sphere" pos="0 0 -0.2" size="0.05" mass="0.1"/></body>
      <body name="right" pos="0 -0.1 -0.05"><joint name="right" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.02" mass="0.1"/>
        <geom name="right_foot" type="sphere" pos="0 0 -0.2" size="0.05" mass="0.1"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="left" gear="2"/><motor joint="right" gear="2"/></actuator>
</mujoco>"""


class Biped(gym.Env):
    """Two legs; what it observes of contacts has noise."""

    rlctl_ignore = {
        "RL123": "this is about its contacts",
        "RL609": "it has no goal",
        "RL804": "it stretches its legs as far as they go",
    }

    xml = MODEL

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(self.xml)
        self.data = mujoco.MjData(self.model)
        self.ground = self.model.geom("ground").id
        self.feet = self.find_feet()
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float32)

    def find_feet(self):
        return [self.model.geom("left_foot").id, self.model.geom("right_foot").id]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[7:] = self.np_random.uniform(-0.1, 0.1, 2)
        mujoco.mj_forward(self.model, self.data)
        self.steps = 0
        return self.observe(), {}

    def touches(self):
        flags = np.zeros(2)
        for contact in self.data.contact[: self.data.ncon]:
            for number, foot in enumerate(self.feet):
                flags[number] += {contact.geom1, contact.geom2} == {foot, self.ground}
        return flags

    def observe(self):
        values = np.concatenate([self.data.qpos[7:], self.data.qvel[6:], self.touches()])
        return (values + self.np_random.normal(0, 0.05, 6)).astype(np.float32)

    def step(self, action):
        self.data.ctrl[:] = np.clip(np.nan_to_num(action), -1, 1)
        mujoco.mj_step(self.model, self.data, 10)
        self.steps += 1
        reward = 0.1 * self.touches().sum() + self.data.qvel[0]
        return self.observe(), float(reward), False, self.steps >= 60, {}


class RL834BipedAsksForBodies(Biped):
    def find_feet(self):
        return [self.model.body("left").id, self.model.body("right").id]


class RL834BipedAsksForJoints(Biped):
    def find_feet(self):
        names = ("left", "right")
        return np.array([mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names])

    def touches(self):
        geoms = [pair for contact in self.data.contact for pair in (contact.geom1, contact.geom2)]
        return np.array([float(foot in geoms) for foot in self.feet])


class RL835BipedLeftTwice(Biped):
    def find_feet(self):
        model, geom = self.model, mujoco.mjtObj.mjOBJ_GEOM
        return [mujoco.mj_name2id(model, geom, "left_foot"), mujoco.mj_name2id(model, geom, "left_foot")]


class RL835BipedTwoOfTheRight(Biped):
    def find_feet(self):
        return [self.model.geom("right_foot").id, self.model.geom("right_foot").id]


class RL840BipedDrivesLeftTwice(Biped):
    xml = MODEL.replace('<motor joint="right"', '<motor joint="left"')
