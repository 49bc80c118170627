"""Robots that read a part of what they observe before they move, next to their twins: MuJoCo, PyBullet and NumPy."""

import mujoco
import numpy as np
import pybullet as p
from robots import Robot

DT = 0.1  # [s]
XML = """
<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody><body name="crab">
<joint name="x" type="slide" axis="1 0 0" damping="1"/><joint name="y" type="slide" axis="0 1 0" damping="1"/>
<joint name="yaw" type="hinge" axis="0 0 1" damping="0.1"/><geom type="box" size="0.2 0.1 0.05" mass="1"/>
</body></worldbody><actuator><motor joint="x" ctrlrange="-1 1"/><motor joint="y" ctrlrange="-1 1"/>
<motor joint="yaw" ctrlrange="-1 1" gear="0.1"/></actuator></mujoco>
"""


class Crab(Robot):
    """It walks to a shell, and sees its velocity and its place from its own side, with noise. MuJoCo."""

    joints = 3

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        super().__init__()

    def size(self):
        return 9

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-1, 1, 3)
        self.shell = self.np_random.uniform(-1, 1, 2)
        mujoco.mj_forward(self.model, self.data)
        self.look()

    def look(self):
        c, s = np.cos(self.data.qpos[2]), np.sin(self.data.qpos[2])
        to_body = np.array([[c, s], [-s, c]])
        self.velocity = to_body @ self.data.qvel[:2]
        self.way = to_body @ (self.shell - self.data.qpos[:2])

    def physics(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=5)
        mujoco.mj_forward(self.model, self.data)

    def move(self, action):
        self.physics(action)
        self.look()

    def observe(self):
        noise = self.np_random.normal(0, 0.002, 2)
        rest = [np.cos(self.data.qpos[2]), np.sin(self.data.qpos[2]), self.data.qvel[2]]
        return np.concatenate([self.velocity + noise, self.way - noise, self.shell, rest]).astype(np.float32)

    def distance(self):
        return float(np.linalg.norm(self.shell - self.data.qpos[:2]))

    def is_success(self):
        return self.distance() < 0.05

    def reward(self):
        return -self.distance()


class RL815CrabLooksFirst(Crab):
    def move(self, action):
        self.look()
        self.physics(action)


class CrabSteersByIt(Crab):
    """It reads its velocity before it moves, to brake, and again afterwards."""

    def move(self, action):
        speed = self.data.qvel[:2].copy()
        self.physics(action - 0.1 * np.append(speed, 0.0))
        self.look()


class CrabKeepsTime(Crab):
    """It turns its own clock before it moves."""

    def start(self):
        super().start()
        self.beat = np.array([0.0, 1.0])

    def move(self, action):
        sine, cosine = self.beat
        self.beat = np.array([0.9 * sine + 0.435 * cosine, 0.9 * cosine - 0.435 * sine])
        super().move(action)

    def observe(self):
        return np.concatenate([self.velocity, self.way, self.shell, self.beat, self.data.qvel[2:3]]).astype(np.float32)


class CrabKeepsAView(Crab):
    """What it reads before it moves is a view of what MuJoCo changes."""

    def look(self):
        super().look()
        self.velocity = self.data.qvel[:2]

    def move(self, action):
        self.look()
        self.physics(action)
        super().look()
        self.velocity = self.data.qvel[:2]


class Snail(Robot):
    """It has no engine, and goes to a leaf."""

    def size(self):
        return 6

    def start(self):
        self.state = {"place": self.np_random.uniform(-1, 1, 2), "velocity": np.zeros(2)}
        self.leaf = self.np_random.uniform(-1, 1, 2)
        self.seen = self.state["place"].copy()

    def glide(self, action):
        self.state["velocity"] = 0.8 * self.state["velocity"] + 0.3 * action
        self.state["place"] = self.state["place"] + DT * self.state["velocity"]

    def move(self, action):
        self.glide(action)
        self.seen = np.array(self.state["place"])

    def observe(self):
        return np.concatenate([self.seen, self.leaf - self.seen, self.state["velocity"]]).astype(np.float32)

    def is_success(self):
        return bool(np.linalg.norm(self.leaf - self.state["place"]) < 0.1)

    def reward(self):
        return -float(np.linalg.norm(self.leaf - self.state["place"]))


class SnailSeesFirst(Snail):
    def move(self, action):
        self.seen = np.array(self.state["place"])
        self.glide(action)


class SnailRemembers(Snail):
    """It sees where it was, next to where it is."""

    def move(self, action):
        self.seen = np.array(self.state["place"])
        self.glide(action)

    def observe(self):
        return np.concatenate([self.seen, self.leaf - self.state["place"], self.state["place"]]).astype(np.float32)


class SnailGains(Snail):
    """It sees how fast it comes nearer."""

    def far(self):
        return float(np.linalg.norm(self.leaf - self.state["place"]))

    def move(self, action):
        far = self.far()
        self.glide(action)
        self.seen = np.array([far - self.far(), self.far()])


class Lobster(Robot):
    """PyBullet moves it, and it sees joints and its claw."""

    def __init__(self):
        self.client = p.connect(p.DIRECT)
        shapes = [p.createCollisionShape(p.GEOM_SPHERE, radius=0.05, physicsClientId=self.client)] * 2
        self.body = p.createMultiBody(
            0.0,
            linkMasses=[1.0, 0.5],
            linkCollisionShapeIndices=shapes,
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0, 0, 0.2], [0.4, 0, 0]],
            linkOrientations=[[0, 0, 0, 1]] * 2,
            linkInertialFramePositions=[[0.2, 0, 0]] * 2,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2,
            linkParentIndices=[0, 1],
            linkJointTypes=[p.JOINT_REVOLUTE] * 2,
            linkJointAxis=[[0, 0, 1]] * 2,
            physicsClientId=self.client,
        )
        super().__init__()

    def size(self):
        return 9

    def start(self):
        for joint in range(2):
            p.resetJointState(self.body, joint, self.np_random.uniform(-1, 1), physicsClientId=self.client)
        self.spot = self.np_random.uniform(-0.5, 0.5, 2)
        self.q, self.qd = self.read()

    def read(self):
        states = p.getJointStates(self.body, [0, 1], physicsClientId=self.client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def claw(self):
        state = p.getLinkState(self.body, 1, computeForwardKinematics=True, physicsClientId=self.client)
        return np.array(state[0])

    def drive(self, action):
        p.setJointMotorControlArray(
            self.body,
            [0, 1],
            p.VELOCITY_CONTROL,
            targetVelocities=2 * action,
            forces=[5, 5],
            physicsClientId=self.client,
        )
        for _ in range(8):
            p.stepSimulation(physicsClientId=self.client)

    def move(self, action):
        self.drive(action)
        self.q, self.qd = self.read()

    def observe(self):
        return np.concatenate([np.sin(self.q), np.cos(self.q), self.qd, self.claw()]).astype(np.float32)

    def is_success(self):
        return bool(np.linalg.norm(self.claw()[:2] - self.spot) < 0.05)

    def reward(self):
        return -float(np.linalg.norm(self.claw()[:2] - self.spot))


class LobsterReadsFirst(Lobster):
    def move(self, action):
        self.q, self.qd = self.read()
        self.drive(action)


class LobsterInOneStep(Lobster):
    """Its step has all in local variables."""

    def step(self, action):
        self.steps += 1
        self.drive(action)
        q, qd = self.read()
        observed = np.concatenate([np.sin(q), np.cos(q), qd, self.claw()]).astype(np.float32)
        return observed, self.reward(), self.is_success(), self.steps >= 60, {"is_success": self.is_success()}


class LobsterReadsFirstInOneStep(Lobster):
    def step(self, action):
        self.steps += 1
        q, qd = self.read()
        self.drive(action)
        observed = np.concatenate([np.sin(q), np.cos(q), qd, self.claw()]).astype(np.float32)
        return observed, self.reward(), self.is_success(), self.steps >= 60, {"is_success": self.is_success()}
