"""A robot arm in MuJoCo that brings its hand to a place; some places are out of its reach."""

import mujoco
import numpy as np
from broken_meaning import Robot

ARM = """
<mujoco>
  <option gravity="0 0 0" timestep="0.01"/>
  <default><joint damping="1"/><geom type="capsule" size="0.03" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0.5 0 0.2">
      <joint name="turn" axis="0 0 1"/>
      <geom fromto="0 0 0 0 0 0.2"/>
      <body pos="0 0 0.2">
        <joint name="shoulder" axis="0 1 0" range="-100 100" limited="true"/>
        <geom fromto="0 0 0 0.4 0 0"/>
        <body pos="0.4 0 0">
          <joint name="elbow" axis="0 1 0" range="-120 120" limited="true"/>
          <geom fromto="0 0 0 0.3 0 0"/>
          <site name="hand" pos="0.3 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="turn" gear="2"/><motor joint="shoulder" gear="2"/><motor joint="elbow" gear="2"/>
  </actuator>
</mujoco>
"""


PLANAR = """
<mujoco>
  <option gravity="0 0 0" timestep="0.005"/>
  <default><joint damping="0.3"/><geom type="capsule" size="0.02" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 0.1" euler="{tilt} 0 0">
      <joint name="shoulder" axis="0 0 1" range="-170 170" limited="true"/>
      <geom fromto="0 0 0 0.3 0 0"/>
      <body pos="0.3 0 0">
        <joint name="elbow" axis="0 0 1" range="-150 150" limited="true"/>
        <geom fromto="0 0 0 0.25 0 0"/>
        <site name="hand" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
</mujoco>
"""


class Arm(Robot):
    """An arm of three joints; its hand is at most 0.73 m from its base."""

    numbers = 3
    near = 0.1  # [m]
    farthest = 0.6  # goal, from the shoulder [m]

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)
        super().__init__()

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos = self.np_random.uniform(-1.0, 1.0, 3)
        mujoco.mj_forward(self.model, self.data)
        self.goal = self.draw_goal()

    def draw_goal(self):
        direction = self.np_random.normal(size=3)
        distance = self.np_random.uniform(0.3, self.farthest)
        return np.array([0.5, 0.0, 0.4]) + distance * direction / np.linalg.norm(direction)

    def move(self, action):
        self.data.ctrl = action
        mujoco.mj_step(self.model, self.data, 4)
        mujoco.mj_forward(self.model, self.data)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.data.site("hand").xpos))

    def observe(self):
        to_goal = self.goal - self.data.site("hand").xpos
        return np.concatenate([self.data.qpos, self.data.qvel, to_goal]).astype(np.float32)

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL619ArmFarGoals(Arm):
    farthest = 1.4


class ArmGoalsInMillimetres(Arm):
    def draw_goal(self):
        return 1000 * super().draw_goal()


class ArmByChance(Arm):
    """Draws its goals from a generator without a seed: nothing can be paired with them."""

    def draw_goal(self):
        self._np_random = np.random.default_rng()
        return super().draw_goal()


class ArmUnclearReward(Arm):
    """Observes its goal, whose difference to itself is where the base is; its reward does not tell the distance."""

    def __init__(self):
        global ARM
        ARM = ARM.replace("0.5 0 0.2", "0 0 0")
        super().__init__()

    def observe(self):
        rest = self.data.site("hand").xpos, self.goal
        return np.concatenate([self.data.qpos, self.data.qvel, *rest]).astype(np.float32)

    def reward(self, action):
        return np.exp(-3 * self.distance()) + 0.1 * self.data.qvel[0]


class RL622ArmKeepsAway(Arm):
    def reward(self, action):
        return self.distance() - 0.02 * np.square(action).sum()


class RL623ArmComesNearer(Arm):
    """Is paid for the way towards its goal, and pays for the way back."""

    def start(self):
        super().start()
        self.before = self.distance()

    def progress(self):
        before, self.before = self.before, self.distance()
        return before - self.before  # [m]

    def reward(self, action):
        return 10 * self.progress() - 0.02 * np.square(action).sum()


class RL623ArmShakes(RL623ArmComesNearer):
    def reward(self, action):
        return 10 * max(self.progress(), 0.0) - 0.02 * np.square(action).sum()


class RL121ArmMovesItsGoal(Arm):
    """Subtracts where its hand is from the goal itself."""

    rlctl_ignore = {"RL611": "a consequence"}

    def observe(self):
        to_goal = self.goal
        to_goal -= 0.01 * self.data.site("hand").xpos
        return np.concatenate([self.data.qpos, self.data.qvel, to_goal]).astype(np.float32)


class PlanarArm(Arm):
    """Its goal is a point in space, of which a constant is not observed: the height of the plane in which it moves."""

    numbers = 2
    near = 0.03  # [m]
    tilt = 0  # of the plane [deg]
    seen = (0, 1)
    """The axes of the plane."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(PLANAR.format(tilt=self.tilt))
        self.data = mujoco.MjData(self.model)
        Robot.__init__(self)

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos = self.np_random.uniform(-1.0, 1.0, 2)
        mujoco.mj_forward(self.model, self.data)
        self.goal = self.draw_goal()

    def draw_goal(self):
        distance, angle = self.np_random.uniform(0.25, 0.5), self.np_random.uniform(-1.5, 1.5)
        goal = np.array([0.0, 0.0, 0.1])
        goal[list(self.seen)] += distance * np.array([np.cos(angle), np.sin(angle)])
        return goal

    def observe(self):
        places = [place[list(self.seen)] for place in (self.data.site("hand").xpos, self.goal)]
        return np.concatenate([self.data.qpos, self.data.qvel, *places]).astype(np.float32)


class UprightArm(PlanarArm):
    """Moves in a vertical plane, and sees its goal from its hand: the constant is in the middle."""

    tilt, seen = 90, (0, 2)

    def observe(self):
        way = (self.goal - self.data.site("hand").xpos)[[0, 2]]
        return np.concatenate([self.data.qpos, self.data.qvel, way]).astype(np.float32)


class PlanarArmSeesAll(PlanarArm):
    """Observes the constant too."""

    def observe(self):
        places = self.data.site("hand").xpos, self.goal
        return np.concatenate([self.data.qpos, self.data.qvel, *places]).astype(np.float32)


class PosedArm(PlanarArm):
    """Its goal is a pose whose orientation is constant."""

    def draw_goal(self):
        return np.array([*super().draw_goal(), 1.0, 0.0, 0.0, 0.0])

    def distance(self):
        return float(np.linalg.norm(self.goal[:3] - self.data.site("hand").xpos))


class RL622PlanarArmKeepsAway(RL622ArmKeepsAway, PlanarArm): ...


class RL622UprightArmKeepsAway(RL622ArmKeepsAway, UprightArm): ...


class RL622PosedArmKeepsAway(PosedArm):
    def reward(self, action):
        return self.distance() - 0.02 * np.square(action).sum()


class RL619UprightArmFarGoals(UprightArm):
    rlctl_ignore = {"RL611": "a consequence"}

    def draw_goal(self):
        goal = super().draw_goal()
        return goal + 0.6 * (goal - np.array([0.0, 0.0, 0.1]))


class RL624PlanarArmInMillimetres(PlanarArm):
    """Compares a distance in millimetres with a tolerance in metres."""

    def distance(self):
        return 1000 * super().distance()

    def reward(self, action):
        return -super().distance() - 0.02 * np.square(action).sum()


class PlanarArmIsThere(PlanarArm):
    """Its episodes end with their first step, in success."""

    near = 10.0
