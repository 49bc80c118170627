"""Robots whose success is that of another link than the observed one, next to their twins."""

import mujoco
import numpy as np
import pybullet as p
from broken_hindsight import Hindsight
from broken_meaning import Robot
from broken_overlaps import ArmAboveCube
from broken_reach import Arm as Reach
from broken_reach_bullet import Reacher
from mujoco_robots import MujocoArm
from robots import Pusher

GANTRY = """
<mujoco><option timestep="0.01" gravity="0 0 0"/>
<worldbody>
<body name="rail"><joint name="x" type="slide" axis="1 0 0" range="-1 1" limited="true" damping="3"/>
  <geom type="box" size=".1 .1 .1"  mass="1" contype="0" conaffinity="0"/>
  <body name="bridge" pos="0 .2 0"><joint name="y" type="slide" axis="0 1 0" range="-1 1" limited="true" damping="3"/>
    <geom type="box" size=".05 .05 .1" mass=".5" contype="0" conaffinity="0"/>
    <body name="tool" pos="0 .3 .2"><geom type="sphere" size=".03" mass=".1" contype="0" conaffinity="0"/></body>
  </body></body></worldbody>
<actuator><motor joint="x" gear="6"/><motor joint="y" gear="6"/></actuator></mujoco>
"""


class Gantry(Robot):
    """A tool on two rails goes to a place."""

    judged = "tool"

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(GANTRY)
        self.data = mujoco.MjData(self.model)
        super().__init__()

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos = self.np_random.uniform(-0.5, 0.5, 2)
        mujoco.mj_forward(self.model, self.data)
        self.goal = np.array([*self.np_random.uniform([-0.7, -0.3], [0.7, 0.9]), 0.2])

    def move(self, action):
        self.data.ctrl = action
        mujoco.mj_step(self.model, self.data, 4)
        mujoco.mj_forward(self.model, self.data)

    def observe(self):
        to_goal = self.goal - self.data.body("tool").xpos
        return np.concatenate([self.data.qpos, self.data.qvel, to_goal]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm((self.goal - self.data.body(self.judged).xpos)[:2]))

    def reward(self, action):
        return -self.distance() - 0.02 * np.square(action).sum()


class RL626GantryBridge(Gantry):
    rlctl_ignore = {"RL110": "its rails are level", "RL619": "a consequence"}
    judged = "bridge"


class RL626ArmElbow(MujocoArm):
    rlctl_ignore = {"RL611": "a consequence"}

    def distance(self):
        return float(np.linalg.norm(self.goal - self.data.body("lower").xpos))


class RL626ReachElbow(Reach):
    def distance(self):
        return float(np.linalg.norm(self.goal - self.data.xpos[3]))


class RL626ReacherElbow(Reacher):
    """Observes where its tip is, and is judged by its second link."""

    def to_judged(self):
        link = p.getLinkState(self.robot, 1, computeForwardKinematics=True, physicsClientId=self.client)
        return self.goal - np.array(link[4])

    def is_success(self):
        return bool(np.linalg.norm(self.to_judged()) < 0.2)

    def reward(self):
        return -float(np.linalg.norm(self.to_judged()))


class CrankPoints(Pusher):
    """Its crank goes to a place on the table."""

    judged = 2

    def start(self):
        super().start()
        angle = self.np_random.uniform(-0.6, 0.6)
        self.goal = 0.25 * np.array([np.cos(angle), np.sin(angle)])

    def size(self):
        return super().size() + 2

    def tip(self, link=2):
        state = p.getLinkState(self.robot, link, computeForwardKinematics=True, physicsClientId=self.client)
        return np.array(state[4][:2])

    def observe(self):
        return np.concatenate([super().observe(), self.goal - self.tip()]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.tip(self.judged)))

    def reward(self):
        return -self.distance()

    def info(self, success):
        return {"is_success": self.distance() < 0.03}


class RL626CrankOtherLink(CrankPoints):
    rlctl_ignore = {**CrankPoints.rlctl_ignore, "RL611": "a consequence", "RL619": "a consequence"}
    judged = 1


class CrankPlacesCube(CrankPoints):
    """It brings its cube to a place on the table."""

    def size(self):
        return super().size() + 2

    def cube_place(self):
        place, _ = p.getBasePositionAndOrientation(self.cube, physicsClientId=self.client)
        return np.array(place[:2])

    def observe(self):
        to_goal = self.goal - self.cube_place()
        return np.concatenate([super(CrankPoints, self).observe(), self.tip(), to_goal]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm(self.goal - self.cube_place()))


class RL626CrankGoesItself(CrankPlacesCube):
    rlctl_ignore = {**CrankPlacesCube.rlctl_ignore, "RL611": "a consequence"}

    def info(self, success):
        return {"is_success": bool(np.linalg.norm(self.goal - self.tip()) < 0.03)}


class ArmBringsCube(ArmAboveCube):
    """The cube belongs at the goal."""

    def observe(self):
        cube = self.data.qpos[3:6]
        return np.concatenate([self.data.qpos[:6], self.data.qvel[:6], self.tip(), self.goal - cube])

    def distance(self):
        return float(np.linalg.norm(self.goal - self.data.qpos[3:6]))


class RL626ArmGoesItself(ArmBringsCube):
    def succeeds(self):
        return bool(np.linalg.norm(self.goal - self.tip()) < 0.05)


class ArmAchieves(Hindsight, ArmBringsCube):
    """What is achieved is the cube's place; the way to the goal is not observed."""

    def observe(self):
        return np.concatenate([self.data.qpos[:3], self.data.qvel[:6], self.tip()])

    def achieved(self):
        return self.data.qpos[3:6].copy()


class RL626ArmAchievesItself(ArmAchieves):
    def succeeds(self):
        return bool(np.linalg.norm(self.goal - self.tip()) < 0.05)
