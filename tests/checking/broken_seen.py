"""Robots that turn a way of the world by their orientation instead of its inverse, next to their twins: MuJoCo,
PyBullet and NumPy."""

import math

import mujoco
import numpy as np
import pybullet as p
from robots import Robot

DT = 0.1  # [s]
XML = """
<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody>
<body name="probe"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="1" contype="0" conaffinity="0"/></body>
<body name="rock" pos="2 0 0"><freejoint/><geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>
"""


class Probe(Robot):
    """It sees a rock, which drifts, from its own side. MuJoCo."""

    joints = 3

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        self.probe, self.rock = (self.model.body(name).id for name in ("probe", "rock"))
        super().__init__()

    def size(self):
        return 6

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        q = self.np_random.normal(size=4)
        self.data.qpos[3:7] = q / np.linalg.norm(q)
        self.data.qpos[7:10] = self.np_random.uniform(-1, 1, 3)
        self.data.qvel[6:9] = self.np_random.uniform(-0.2, 0.2, 3)
        mujoco.mj_forward(self.model, self.data)

    def move(self, action):
        self.data.qfrc_applied[3:6] = 0.002 * action
        mujoco.mj_step(self.model, self.data, nstep=5)
        mujoco.mj_forward(self.model, self.data)

    def see(self):
        matrix = self.data.xmat[self.probe].reshape(3, 3)
        return matrix.T @ (self.data.xpos[self.rock] - self.data.xpos[self.probe])

    def observe(self):
        return np.concatenate([self.see(), self.data.qvel[3:6]]).astype(np.float32)

    def is_success(self):
        return bool(np.linalg.norm(self.data.xpos[self.rock] - self.data.xpos[self.probe]) < 0.05)

    def reward(self):
        return -float(np.linalg.norm(self.data.qvel[3:6]))


class ProbeSeesByTheMatrix(Probe):
    def see(self):
        matrix = self.data.xmat[self.probe].reshape(3, 3)
        return matrix @ (self.data.xpos[self.rock] - self.data.xpos[self.probe])


class ProbeOfMujoco(Probe):
    """It calls MuJoCo's functions, which write into an array."""

    def see(self):
        back, seen = np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, self.data.qpos[3:7])
        mujoco.mju_rotVecQuat(seen, self.data.qpos[7:10] - self.data.qpos[0:3], back)
        return seen


class ProbeForgetsToNegate(Probe):
    def see(self):
        seen = np.zeros(3)
        mujoco.mju_rotVecQuat(seen, self.data.qpos[7:10] - self.data.qpos[0:3], self.data.qpos[3:7])
        return seen


class Scout(Robot):
    """It is a cart that turns in the plane, and sees a flag. NumPy."""

    def size(self):
        return 3

    def start(self):
        self.x, self.y = self.np_random.uniform(-1, 1, 2)
        self.phi, self.turning = self.np_random.uniform(-3, 3), 0.0
        self.flag = self.np_random.uniform(-2, 2, 2)

    def move(self, action):
        self.turning = 0.8 * self.turning + action[1]
        self.phi += DT * self.turning
        self.x += DT * action[0] * math.cos(self.phi)
        self.y += DT * action[0] * math.sin(self.phi)

    def distance(self):
        return math.hypot(self.flag[0] - self.x, self.flag[1] - self.y)

    def observe(self):
        dx, dy = self.flag[0] - self.x, self.flag[1] - self.y
        c, s = math.cos(self.phi), math.sin(self.phi)
        return np.array([*self.see(c, s, dx, dy), self.turning], np.float32)

    def see(self, c, s, dx, dy):
        return c * dx + s * dy, c * dy - s * dx

    def is_success(self):
        return self.distance() < 0.1

    def reward(self):
        return -self.distance()


class ScoutInObserve(Scout):
    def observe(self):
        dx, dy = self.flag[0] - self.x, self.flag[1] - self.y
        c, s = math.cos(self.phi), math.sin(self.phi)
        return np.array([c * dx + s * dy, c * dy - s * dx, self.turning], np.float32)


class ScoutSeesTheOtherWay(Scout):
    def observe(self):
        dx, dy = self.flag[0] - self.x, self.flag[1] - self.y
        c, s = math.cos(self.phi), math.sin(self.phi)
        return np.array([c * dx - s * dy, s * dx + c * dy, self.turning], np.float32)


def turn_about_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


class Loader(Robot):
    """An arm with a base that turns, and it sees a block from its cup, in the frame that turns with it. PyBullet."""

    axis = (0, 0, 1)

    def __init__(self):
        self.client = p.connect(p.DIRECT)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.02, physicsClientId=self.client)
        self.arm = p.createMultiBody(
            0.0,
            linkMasses=[1.0, 0.5],
            linkCollisionShapeIndices=[-1, -1],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0, 0, 0.3], [0.3, 0, 0]],
            linkOrientations=[[0, 0, 0, 1]] * 2,
            linkInertialFramePositions=[[0.1, 0, 0]] * 2,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2,
            linkParentIndices=[0, 1],
            linkJointTypes=[p.JOINT_REVOLUTE] * 2,
            linkJointAxis=[list(self.axis), [0, 1, 0]],
            physicsClientId=self.client,
        )
        self.block = p.createMultiBody(0.1, shape, physicsClientId=self.client)
        super().__init__()

    def size(self):
        return 7

    def start(self):
        for joint in range(2):
            p.resetJointState(self.arm, joint, self.np_random.uniform(-1.5, 1.5), physicsClientId=self.client)
        place = [*self.np_random.uniform(-0.4, 0.4, 2), 0.2]
        p.resetBasePositionAndOrientation(self.block, place, [0, 0, 0, 1], physicsClientId=self.client)
        p.resetBaseVelocity(self.block, [0.1, 0, 0], [0, 0, 0], physicsClientId=self.client)

    def move(self, action):
        p.setJointMotorControlArray(
            self.arm,
            [0, 1],
            p.VELOCITY_CONTROL,
            targetVelocities=2 * action,
            forces=[9, 9],
            physicsClientId=self.client,
        )
        for _ in range(8):
            p.stepSimulation(physicsClientId=self.client)

    def cup(self):
        state = p.getLinkState(self.arm, 1, computeForwardKinematics=True, physicsClientId=self.client)
        return np.array(state[0])

    def block_place(self):
        return np.array(p.getBasePositionAndOrientation(self.block, physicsClientId=self.client)[0])

    def see(self, q):
        return turn_about_z(q[0]).T @ (self.block_place() - self.cup())

    def observe(self):
        states = p.getJointStates(self.arm, [0, 1], physicsClientId=self.client)
        q = np.array([state[0] for state in states])
        return np.concatenate([np.sin(q), np.cos(q), self.see(q)]).astype(np.float32)

    def is_success(self):
        return bool(np.linalg.norm(self.block_place() - self.cup()) < 0.04)

    def reward(self):
        return -float(np.linalg.norm(self.block_place() - self.cup()))


class LoaderSeesTheOtherWay(Loader):
    def see(self, q):
        return turn_about_z(q[0]) @ (self.block_place() - self.cup())


class LoaderOnItsHead(Loader):
    """Its joint counts clockwise."""

    axis = (0, 0, -1)

    def see(self, q):
        return turn_about_z(q[0]) @ (self.block_place() - self.cup())


class LoaderByPoses(Loader):
    """It transforms the way by the pose of its first link."""

    def see(self, q):
        quat = p.getLinkState(self.arm, 0, computeForwardKinematics=True, physicsClientId=self.client)[1]
        way = self.block_place() - self.cup()
        _, back = p.invertTransform([0, 0, 0], quat)
        seen, _ = p.multiplyTransforms([0, 0, 0], back, way, [0, 0, 0, 1])
        return np.array(seen)


class LoaderByThePoseItself(Loader):
    def see(self, q):
        quat = p.getLinkState(self.arm, 0, computeForwardKinematics=True, physicsClientId=self.client)[1]
        way = self.block_place() - self.cup()
        seen, _ = p.multiplyTransforms([0, 0, 0], quat, way, [0, 0, 0, 1])
        return np.array(seen)
