"""Robots that keep a value in reset before they are placed, next to their twins: NumPy, MuJoCo and PyBullet."""

import mujoco
import numpy as np
import pybullet as p
from gymnasium import spaces
from robots import Robot

XML = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<body name="raft"><joint name="x" type="slide" axis="1 0 0" damping="2"/><joint name="y" type="slide" axis="0 1 0"
 damping="2"/><joint name="yaw" type="hinge" axis="0 0 1" damping="1"/><geom type="box" size="0.2 0.1 0.05" mass="1"
 contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-1 1" gear="3"/><motor joint="yaw" ctrlrange="-1 1"/></actuator></mujoco>
"""


class Raft(Robot):
    """It is paid for what it moves ahead of where it started, and for keeping its heading. MuJoCo."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        self.raft = self.model.body("raft").id
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float32)

    def yaw(self):
        matrix = self.data.xmat[self.raft].reshape(3, 3)
        return float(np.arctan2(matrix[1, 0], matrix[0, 0]))

    def place_it(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-1, 1, 3)
        mujoco.mj_forward(self.model, self.data)

    def keep(self):
        self.heading = self.yaw()
        self.prev_x = float(self.data.qpos[0])

    def start(self):
        self.place_it()
        self.keep()

    def observe(self):
        turned = self.yaw() - self.heading
        return np.array([*self.data.qpos, self.data.qvel[0], np.sin(turned), np.cos(turned)], np.float32)

    def move(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=4)
        mujoco.mj_forward(self.model, self.data)

    def is_success(self):
        return False

    def reward(self):
        x = float(self.data.qpos[0])
        gained, self.prev_x = x - self.prev_x, x
        return 10 * gained - 0.1 * abs(self.yaw() - self.heading)


class RaftKeepsFirst(Raft):
    def start(self):
        self.keep()
        self.place_it()


class RaftHeadingOfTheModel(Raft):
    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        start_yaw = self.yaw()
        self.data.qpos[:] = self.np_random.uniform(-1, 1, 3)
        mujoco.mj_forward(self.model, self.data)
        self.prev_x = float(self.data.qpos[0])
        self.heading = start_yaw


class RaftNominal(Raft):
    """It is paid for being near the place where its model has it."""

    def place_it(self):
        mujoco.mj_resetData(self.model, self.data)
        self.home_x = float(self.data.qpos[0])
        self.rest_pose = self.data.qpos.copy()
        super().place_it()

    def reward(self):
        off = self.data.qpos - self.rest_pose
        return super().reward() - abs(float(self.data.qpos[0]) - self.home_x) - 0.1 * float(np.abs(off).sum())


class RaftSettles(Raft):
    """It drifts for a while after it has been placed; what counts is where it was placed."""

    def start(self):
        self.place_it()
        self.data.qvel[:] = 1.0
        self.keep()
        for _ in range(10):
            mujoco.mj_step(self.model, self.data)


class RaftLevels(Raft):
    """It starts farther away after episodes that got far: that is read before it is placed."""

    level = 0

    def start(self):
        if hasattr(self, "heading"):
            self.last_distance = abs(float(self.data.qpos[0]) - self.prev_x)
            self.level += self.last_distance > 0.5
        super().start()


class Puck(Robot):
    """It glides to a spot, all in a dictionary. NumPy."""

    def size(self):
        return 6

    def distance(self):
        return float(np.linalg.norm(self.state["spot"] - self.state["pos"]))

    def draw(self):
        return {"pos": self.np_random.uniform(-1, 1, 2), "vel": np.zeros(2), "spot": self.np_random.uniform(-1, 1, 2)}

    def start(self):
        self.state = self.draw()
        self.prev_distance = self.distance()

    def observe(self):
        return np.concatenate([self.state[key] for key in ("pos", "vel", "spot")]).astype(np.float32)

    def move(self, action):
        self.state["vel"] = 0.8 * self.state["vel"] + 0.2 * action
        self.state["pos"] = self.state["pos"] + 0.1 * self.state["vel"]

    def is_success(self):
        return self.distance() < 0.2

    def reward(self):
        before, self.prev_distance = self.prev_distance, self.distance()
        return before - self.prev_distance


class RL642PuckDistanceBeforeTheSpot(Puck):
    """The spot is drawn once more after the distance to it has been read."""

    def start(self):
        self.state = self.draw()
        self.prev_distance = self.distance()
        self.state["spot"] = self.np_random.uniform(-1, 1, 2)

    def reward(self):
        distance = self.distance()
        gained = self.prev_distance - distance
        self.prev_distance = distance
        return gained


class PuckGlides(Puck):
    """It glides for a while after it has been placed, without an engine."""

    def start(self):
        self.state = self.draw()
        self.prev_distance = self.distance()
        for _ in range(5):
            self.move(np.ones(2))


class Lander(Robot):
    """It is paid for what it climbs from where it starts. PyBullet."""

    joints = 1

    def __init__(self):
        super().__init__()
        self.cid = p.connect(p.DIRECT)
        p.setTimeStep(0.01, physicsClientId=self.cid)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1, physicsClientId=self.cid)
        self.body = p.createMultiBody(1.0, shape, physicsClientId=self.cid)

    def size(self):
        return 3

    def height(self):
        return p.getBasePositionAndOrientation(self.body, physicsClientId=self.cid)[0][2]

    def place_it(self):
        place = [0, 0, self.np_random.uniform(0, 2)]
        p.resetBasePositionAndOrientation(self.body, place, [0, 0, 0, 1], physicsClientId=self.cid)
        p.resetBaseVelocity(self.body, [0, 0, 0], [0, 0, 0], physicsClientId=self.cid)

    def start(self):
        self.place_it()
        self.begin()

    def begin(self):
        place, _ = p.getBasePositionAndOrientation(self.body, physicsClientId=self.cid)
        self.start_height = place[2]

    def observe(self):
        climbed = self.height() - self.start_height
        return np.array([self.height(), climbed, self.start_height], np.float32)

    def move(self, action):
        for _ in range(4):
            force = [0, 0, 2 * float(action[0])]
            p.applyExternalForce(self.body, -1, force, [0, 0, 0], p.LINK_FRAME, physicsClientId=self.cid)
            p.stepSimulation(physicsClientId=self.cid)

    def is_success(self):
        return False

    def reward(self):
        return self.height() - self.start_height


class LanderBeginsFirst(Lander):
    def start(self):
        self.begin()
        self.place_it()


class LanderUnpacksFirst(Lander):
    def start(self):
        place, orientation = p.getBasePositionAndOrientation(self.body, physicsClientId=self.cid)
        self.place_it()
        self.start_height = float(place[2])
        self.tilt = p.getEulerFromQuaternion(orientation)[1]
