"""Robots whose motors have the strength of other joints, and their twins."""

import mujoco
import numpy as np
import pybullet as p

from tests.checking.mujoco_robots import MujocoRobot
from tests.checking.robots import Arm, Robot, Simulated

CRANE = """
<mujoco><compiler angle="degree"/><option timestep="0.004"/>
<default><joint damping="1" armature=".02"/></default>
<worldbody><body name="slew" pos="0 0 1"><joint name="slew" axis="0 0 1" range="-170 170"/>
  <geom type="capsule" fromto="0 0 0 0 0 .3" size=".05" mass="4"/>
  <body name="trolley" pos=".4 0 .3"><joint name="trolley" type="slide" axis="1 0 0" range="-.2 .4"/>
    <geom type="box" size=".05 .05 .03" mass="2"/>
    <body name="hook" pos="0 0 -.1"><joint name="hoist" type="slide" axis="0 0 1" range="-.6 .05"/>
      <geom type="sphere" size=".04" mass="5"/></body></body></body></worldbody>
<actuator>{motors}</actuator></mujoco>
"""
WINCH = '<velocity joint="{joint}" kv="80" ctrlrange="-.5 .5" forcerange="-{force} {force}"/>'
JOINTS = ("slew", "trolley", "hoist")


class CraneStrengths(MujocoRobot):
    """A crane whose motors are told speeds: the hoist carries 49 N."""

    forces = (40, 20, 120)
    xml = CRANE.format(motors="".join(WINCH.format(joint=j, force=f) for j, f in zip(JOINTS, forces, strict=True)))

    def start(self):
        self.data.qpos[:] = self.np_random.uniform(-0.2, 0.0, 3)

    def move(self, action):
        self.data.ctrl[:] = 0.5 * action
        mujoco.mj_step(self.model, self.data, self.frames)

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reward(self):
        return -abs(self.data.qpos[2] + 0.3)

    def succeeds(self):
        return bool(abs(self.data.qpos[2] + 0.3) < 0.02)


class CraneStrengthsExchanged(CraneStrengths):
    """Written for trolley and hoist in the other order."""

    forces = (40, 120, 20)
    xml = CRANE.format(motors="".join(WINCH.format(joint=j, force=f) for j, f in zip(JOINTS, forces, strict=True)))


class Forklift(Robot):
    """A mast lifts a fork of 12 kg, and shifts it sideways: speeds, with the forces of a table by joint."""

    forces = {"lift": 300.0, "shift": 60.0}
    order = ("lift", "shift")
    physics_s = 1 / 120

    def __init__(self):
        super().__init__()
        self.client = p.connect(p.DIRECT)
        p.setGravity(0, 0, -9.81, physicsClientId=self.client)
        p.setTimeStep(self.physics_s, physicsClientId=self.client)
        box = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 0.1, 0.02], physicsClientId=self.client)
        self.robot = p.createMultiBody(
            0,
            basePosition=[0, 0, 0.2],
            linkMasses=[8.0, 4.0],
            linkCollisionShapeIndices=[-1, box],
            linkVisualShapeIndices=[-1, -1],
            linkPositions=[[0, 0, 0.1], [0.2, 0, 0]],
            linkOrientations=[[0, 0, 0, 1]] * 2,
            linkInertialFramePositions=[[0, 0, 0]] * 2,
            linkInertialFrameOrientations=[[0, 0, 0, 1]] * 2,
            linkParentIndices=[0, 1],
            linkJointTypes=[p.JOINT_PRISMATIC] * 2,
            linkJointAxis=[[0, 0, 1], [0, 1, 0]],
            physicsClientId=self.client,
        )
        for joint, (low, high) in enumerate([(0.0, 1.2), (-0.3, 0.3)]):
            limits = {"jointLowerLimit": low, "jointUpperLimit": high}
            p.changeDynamics(self.robot, joint, **limits, physicsClientId=self.client)

    def size(self):
        return 4

    def start(self):
        starts = self.np_random.uniform([0.3, -0.2], [0.6, 0.2])
        for joint, position in enumerate(starts):
            p.resetJointState(self.robot, joint, position, 0.0, physicsClientId=self.client)

    def move(self, action):
        p.setJointMotorControlArray(
            self.robot,
            [0, 1],
            p.VELOCITY_CONTROL,
            targetVelocities=[0.6 * action[0], 0.3 * action[1]],
            forces=[self.forces[name] for name in self.order],
            physicsClientId=self.client,
        )
        for _ in range(4):
            p.stepSimulation(physicsClientId=self.client)

    def observe(self):
        states = p.getJointStates(self.robot, [0, 1], physicsClientId=self.client)
        return np.array([state[0] for state in states] + [state[1] for state in states], np.float32)

    def is_success(self):
        return bool(abs(self.observe()[0] - 0.9) < 0.02)

    def reward(self):
        return -abs(float(self.observe()[0]) - 0.9)


class ForkliftOtherOrder(Forklift):
    order = ("shift", "lift")


class ForkliftOfSubsteps(Forklift):
    """PyBullet's motors are as many times stronger as a step has substeps: a quarter of the force is enough."""

    forces = {"lift": 75.0, "shift": 15.0}

    def move(self, action):
        p.setPhysicsEngineParameter(fixedTimeStep=4 * self.physics_s, numSubSteps=4, physicsClientId=self.client)
        super().move(action)


class ArmStrengths(Arm):
    """The wrist has half the strength of the others, as in its model."""

    forces = {"wrist": 50.0, "elbow": 100.0, "shoulder": 100.0}

    def drive(self, targets):
        names = [p.getJointInfo(self.robot, j, physicsClientId=self.client)[1].decode() for j in range(3)]
        forces = [self.forces[name] for name in names]
        p.setJointMotorControlArray(
            self.robot, range(3), p.POSITION_CONTROL, list(targets), forces=forces, physicsClientId=self.client
        )


class ArmStrengthsOfATable(ArmStrengths):
    """In the order of the table, which begins with the wrist."""

    def drive(self, targets):
        forces = list(self.forces.values())
        p.setJointMotorControlArray(
            self.robot, range(3), p.POSITION_CONTROL, list(targets), forces=forces, physicsClientId=self.client
        )


class ArmOfTorques(Arm):
    """A controller of its own, whose torques are limited by those of the model."""

    most = np.array([100.0, 100.0, 50.0])

    def load(self):
        super().load()
        p.setJointMotorControlArray(
            self.robot, range(3), p.VELOCITY_CONTROL, forces=[0.0] * 3, physicsClientId=self.client
        )

    def drive(self, targets):
        self.targets = np.array(targets)

    def target(self, action):
        return self.home + 1.2 * action

    def move(self, action):
        self.drive(self.target(action))
        for _ in range(4):
            position, speed = self.observe().astype(float).reshape(2, 3)
            torques = np.clip(90.0 * (self.targets - position) - 4.0 * speed, -self.most, self.most)
            p.setJointMotorControlArray(
                self.robot, range(3), p.TORQUE_CONTROL, forces=torques.tolist(), physicsClientId=self.client
            )
            p.stepSimulation(physicsClientId=self.client)


class ArmOfOtherTorques(ArmOfTorques):
    most = np.array([50.0, 100.0, 100.0])


class SwingUp(Simulated):
    """A pendulum without stops, whose motor is too weak to hold it: it has to swing."""

    joints = 1
    strength = 1.0

    def load(self):
        self.robot = p.createMultiBody(
            0,
            basePosition=[0, 0, 1],
            linkMasses=[1.0],
            linkCollisionShapeIndices=[-1],
            linkVisualShapeIndices=[-1],
            linkPositions=[[0, 0, 0]],
            linkOrientations=[[0, 0, 0, 1]],
            linkInertialFramePositions=[[0, 0, -0.4]],
            linkInertialFrameOrientations=[[0, 0, 0, 1]],
            linkParentIndices=[0],
            linkJointTypes=[p.JOINT_REVOLUTE],
            linkJointAxis=[[0, 1, 0]],
            physicsClientId=self.client,
        )
        self.home = np.array([1.2])

    def drive(self, targets):
        pass

    def observe(self):
        position, speed = p.getJointState(self.robot, 0, physicsClientId=self.client)[:2]
        return np.array([position, speed], np.float32)

    def move(self, action):
        p.setJointMotorControl2(
            self.robot,
            0,
            p.VELOCITY_CONTROL,
            targetVelocity=5.0 * action[0],
            force=self.strength,
            physicsClientId=self.client,
        )
        for _ in range(4):
            p.stepSimulation(physicsClientId=self.client)

    def is_success(self):
        return False

    def reward(self):
        return -float(np.cos(self.observe()[0]))
