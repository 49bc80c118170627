"""Robots whose commands act in one of several steps of the physics, next to their twins. PyBullet and MuJoCo."""

import mujoco
import numpy as np
import pybullet as p
from gymnasium import spaces
from pybullet_utils.bullet_client import BulletClient
from robots import Robot

SUBSTEPS = 4


class Pod(Robot):
    """It floats in water between two propellers, and dives to a depth."""

    def __init__(self):
        super().__init__()
        self.cid = p.connect(p.DIRECT)
        p.setTimeStep(0.01, physicsClientId=self.cid)
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.2, 0.1, 0.1], physicsClientId=self.cid)
        self.pod = p.createMultiBody(2.0, shape, basePosition=[0, 0, 0], physicsClientId=self.cid)
        p.changeDynamics(self.pod, -1, linearDamping=0.5, angularDamping=0.5, physicsClientId=self.cid)

    def size(self):
        return 7

    def start(self):
        z, tilt = self.np_random.uniform(-0.5, 0.5), self.np_random.uniform(-0.3, 0.3)
        orientation = p.getQuaternionFromEuler([0, tilt, 0])
        p.resetBasePositionAndOrientation(self.pod, [0, 0, z], orientation, physicsClientId=self.cid)
        p.resetBaseVelocity(self.pod, [0, 0, 0], [0, 0, 0], physicsClientId=self.cid)
        self.depth = self.np_random.uniform(-1, 1)

    def read(self):
        place, orientation = p.getBasePositionAndOrientation(self.pod, physicsClientId=self.cid)
        linear, angular = p.getBaseVelocity(self.pod, physicsClientId=self.cid)
        return place, p.getEulerFromQuaternion(orientation)[1], linear, angular

    def observe(self):
        place, tilt, linear, angular = self.read()
        parts = [self.depth - place[2], np.sin(tilt), np.cos(tilt), linear[0], linear[2], angular[1], place[0]]
        return np.array(parts, np.float32)

    def drive(self, action):
        for side, thrust in zip((-0.2, 0.2), action, strict=True):
            where = [side, 0, 0]
            p.applyExternalForce(self.pod, -1, [0, 0, 6 * thrust], where, p.LINK_FRAME, physicsClientId=self.cid)

    def simulate(self):
        p.stepSimulation(physicsClientId=self.cid)

    def move(self, action):
        for _ in range(SUBSTEPS):
            self.drive(action)
            self.simulate()

    def is_success(self):
        return False

    def reward(self):
        place, tilt, _, _ = self.read()
        return -abs(self.depth - place[2]) - 0.1 * abs(tilt)


class PodPushesOnce(Pod):
    def move(self, action):
        self.drive(action)
        for _ in range(SUBSTEPS):
            self.simulate()


class PodPushesAfterwards(Pod):
    def move(self, action):
        [self.simulate() for _ in range(SUBSTEPS)]
        self.drive(action)


class PodBumped(Pod):
    """A fish bumps into it now and then: an impulse."""

    def move(self, action):
        if self.steps % 7 == 0:
            bump = self.np_random.uniform(-20, 20, 3) * [1, 0, 1]
            p.applyExternalForce(self.pod, -1, bump, [0, 0, 0], p.WORLD_FRAME, physicsClientId=self.cid)
        super().move(action)


class PodShaken(Pod):
    """Waves shake it in each step, whatever it does."""

    def move(self, action):
        wave = [0, 0, 4 * self.np_random.normal()]
        p.applyExternalForce(self.pod, -1, wave, [0, 0, 0], p.LINK_FRAME, physicsClientId=self.cid)
        super().move(action)


class PodImpulses(Pod):
    """Its thrusters fire once in each step, on purpose."""

    def move(self, action):
        impulse = 0.1 * float(action.sum())
        force = [0, 0, impulse / 0.01]
        p.applyExternalForce(self.pod, -1, force, [0, 0, 0], p.LINK_FRAME, physicsClientId=self.cid)  # the impulse
        for _ in range(SUBSTEPS):
            self.simulate()


class Client(BulletClient):
    """A client that stays connected: tests use its number again."""

    def __del__(self):
        pass


class Swimmer(Pod):
    """Through a client object, with a drag that it computes itself."""

    def __init__(self):
        Robot.__init__(self)
        self.bullet = Client(p.DIRECT)
        self.bullet.setTimeStep(0.01)
        shape = self.bullet.createCollisionShape(p.GEOM_SPHERE, radius=0.1)
        self.pod = self.bullet.createMultiBody(2.0, shape)

    def start(self):
        b = self.bullet
        b.resetBasePositionAndOrientation(self.pod, [0, 0, self.np_random.uniform(-0.5, 0.5)], [0, 0, 0, 1])
        b.resetBaseVelocity(self.pod, [0, 0, 0], [0, 0, 0])
        self.depth = self.np_random.uniform(-1, 1)

    def read(self):
        place, _ = self.bullet.getBasePositionAndOrientation(self.pod)
        return place, 0.0, *self.bullet.getBaseVelocity(self.pod)

    def drive(self, action):
        velocity = np.array(self.bullet.getBaseVelocity(self.pod)[0])
        wanted = np.array([5 * action[0], 0.0, 5 * action[1]]) - 1.5 * velocity
        self.bullet.applyExternalForce(self.pod, -1, wanted, [0, 0, 0], flags=p.LINK_FRAME)

    def simulate(self):
        self.bullet.stepSimulation()


class SwimmerPushesOnce(Swimmer):
    def move(self, action):
        self.drive(action)
        for _ in range(SUBSTEPS):
            self.simulate()


class Slider(Robot):
    """Two sliding joints with torques."""

    mode = "torques"

    def __init__(self):
        super().__init__()
        self.cid = p.connect(p.DIRECT)
        p.setTimeStep(0.01, physicsClientId=self.cid)
        p.setGravity(0, 0, -9.81, physicsClientId=self.cid)
        ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.05, physicsClientId=self.cid)
        self.body = p.createMultiBody(
            0, -1, -1, [0, 0, 0], linkMasses=[1, 1], linkCollisionShapeIndices=[ball, ball],
            linkVisualShapeIndices=[-1, -1], linkPositions=[[0, 0, 0.5], [0, 1, 0.5]],
            linkOrientations=[[0, 0, 0, 1]] * 2, linkInertialFramePositions=[[0, 0, 0]] * 2,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2, linkParentIndices=[0, 0],
            linkJointTypes=[p.JOINT_PRISMATIC] * 2, linkJointAxis=[[1, 0, 0], [1, 0, 0]], physicsClientId=self.cid,
        )  # fmt: skip
        for joint in (0, 1):
            p.setJointMotorControl2(self.body, joint, p.VELOCITY_CONTROL, force=0, physicsClientId=self.cid)

    def size(self):
        return 6

    def start(self):
        for joint in (0, 1):
            p.resetJointState(self.body, joint, self.np_random.uniform(-0.2, 0.2), 0, physicsClientId=self.cid)
        self.goals = self.np_random.uniform(-0.5, 0.5, 2)

    def states(self):
        states = p.getJointStates(self.body, [0, 1], physicsClientId=self.cid)
        return np.array([one[0] for one in states]), np.array([one[1] for one in states])

    def observe(self):
        return np.concatenate([self.goals, *self.states()]).astype(np.float32)

    def push(self, action):
        torques = [float(3 * one) for one in action]
        p.setJointMotorControlArray(self.body, [0, 1], p.TORQUE_CONTROL, forces=torques, physicsClientId=self.cid)

    def move(self, action):
        for _ in range(SUBSTEPS):
            self.push(action)
            p.stepSimulation(physicsClientId=self.cid)

    def is_success(self):
        return bool(np.abs(self.goals - self.states()[0]).max() < 0.15)

    def reward(self):
        return -float(np.abs(self.goals - self.states()[0]).sum())


class RL838SliderTorquesOnce(Slider):
    def move(self, action):
        for joint, one in enumerate(action):
            p.setJointMotorControl2(
                self.body, joint, controlMode=p.TORQUE_CONTROL, force=3 * one, physicsClientId=self.cid
            )
        for _ in range(SUBSTEPS):
            p.stepSimulation(physicsClientId=self.cid)


class SliderTorquesInTheFirst(Slider):
    def move(self, action):
        for number in range(SUBSTEPS):
            if number == 0:
                self.push(action)
            p.stepSimulation(physicsClientId=self.cid)


class SliderVelocities(Slider):
    """Velocity motors keep their target."""

    def move(self, action):
        for joint, one in enumerate(action):
            p.setJointMotorControl2(
                self.body, joint, p.VELOCITY_CONTROL, targetVelocity=one, force=20, physicsClientId=self.cid
            )
        for _ in range(SUBSTEPS):
            p.stepSimulation(physicsClientId=self.cid)


XML = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<body name="a"><joint name="a" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.05" mass="1" contype="0"
 conaffinity="0"/></body>
<body name="b" pos="0 1 0"><joint name="b" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.05" mass="1"
 contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor joint="a" gear="3" ctrlrange="-1 1"/><motor joint="b" gear="3" ctrlrange="-1 1"/>
</actuator></mujoco>
"""


class Gantry(Robot):
    """Two sliding joints in MuJoCo."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float32)

    def start(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-0.2, 0.2, 2)
        mujoco.mj_forward(self.model, self.data)
        self.goals = self.np_random.uniform(-0.5, 0.5, 2)

    def observe(self):
        return np.concatenate([self.goals, self.data.qpos, self.data.qvel]).astype(np.float32)

    def move(self, action):
        self.data.ctrl[:] = action
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
        self.data.ctrl[:] = 0

    def is_success(self):
        return False

    def reward(self):
        return -float(np.abs(self.goals - self.data.qpos).sum())


class GantryLetsGo(Gantry):
    def move(self, action):
        for number in range(SUBSTEPS):
            self.data.ctrl[:] = action if number == 0 else 0.0
            mujoco.mj_step(self.model, self.data)


class GantryForces(Gantry):
    """By forces on its bodies; one that bumps into them comes now and then, for one step of the physics."""

    def push(self, action):
        self.data.xfrc_applied[1:, 0] = 3 * action

    def move(self, action):
        self.data.qfrc_applied[0] = self.np_random.uniform(-5, 5) if self.steps % 5 == 0 else 0.0
        for _ in range(SUBSTEPS):
            self.push(action)
            mujoco.mj_step(self.model, self.data)
            self.data.xfrc_applied[:] = 0
            self.data.qfrc_applied[:] = 0


class GantryForcesOnce(GantryForces):
    def move(self, action):
        self.push(action)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
            self.data.xfrc_applied[:] = 0


class GantryJointForcesOnce(Gantry):
    def move(self, action):
        self.data.qfrc_applied[:] = 3 * action
        mujoco.mj_step(self.model, self.data)
        self.data.qfrc_applied.fill(0)
        mujoco.mj_step(self.model, self.data, nstep=SUBSTEPS - 1)
