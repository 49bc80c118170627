"""Robots in PyBullet that read another field of a tuple than they mean, next to their twins."""

import numpy as np
import pybullet as p
from robots import Robot

FORCE = 0.5  # [N]


class Ram(Robot):
    """A slider pushes a box that stands on the floor; it never touches it by chance."""

    rlctl_ignore = dict.fromkeys(["RL303", "RL310"], "contacts are not reset to the last bit")
    joints = 1

    def __init__(self):
        super().__init__()
        self.cid = p.connect(p.DIRECT)
        p.setTimeStep(0.01, physicsClientId=self.cid)
        p.setGravity(0, 0, -9.81, physicsClientId=self.cid)
        cube = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1] * 3, physicsClientId=self.cid)
        ground = p.createCollisionShape(p.GEOM_BOX, halfExtents=[3, 3, 0.5], physicsClientId=self.cid)
        self.floor = p.createMultiBody(0, ground, basePosition=[0, 0, -0.5], physicsClientId=self.cid)
        self.box = p.createMultiBody(1.0, cube, basePosition=[1.0, 0, 0.1], physicsClientId=self.cid)
        self.body = p.createMultiBody(
            0, -1, -1, [0, 0, 0.1], linkMasses=[1], linkCollisionShapeIndices=[cube], linkVisualShapeIndices=[-1],
            linkPositions=[[0, 0, 0]], linkOrientations=[[0, 0, 0, 1]], linkInertialFramePositions=[[0, 0, 0]],
            linkInertialFrameOrientations=[[0, 0, 0, 1]], linkParentIndices=[0],
            linkJointTypes=[p.JOINT_PRISMATIC], linkJointAxis=[[1, 0, 0]], physicsClientId=self.cid,
        )  # fmt: skip

    def size(self):
        return 8

    def start(self):
        p.resetJointState(self.body, 0, self.np_random.uniform(-0.2, 0.2), 0, physicsClientId=self.cid)
        place = [self.np_random.uniform(0.6, 0.9), 0, 0.1]
        p.resetBasePositionAndOrientation(self.box, place, [0, 0, 0, 1], physicsClientId=self.cid)
        p.resetBaseVelocity(self.box, [0, 0, 0], [0, 0, 0], physicsClientId=self.cid)

    def points(self):
        return p.getContactPoints(self.body, self.box, physicsClientId=self.cid)

    def touch(self):
        return float(any(one[9] > 0.05 for one in self.points()))

    def joint(self):
        state = p.getJointState(self.body, 0, physicsClientId=self.cid)
        pos, vel = state[0], state[1]
        return pos, vel

    def box_velocity(self):
        linear, angular = p.getBaseVelocity(self.box, physicsClientId=self.cid)
        return linear[0], angular[1]

    def place(self):
        return p.getBasePositionAndOrientation(self.box, physicsClientId=self.cid)[0]

    def observe(self):
        parts = [self.touch(), *self.joint(), *self.box_velocity(), *self.place()]
        return np.array(parts, np.float32)

    def move(self, action):
        p.setJointMotorControl2(
            self.body, 0, p.VELOCITY_CONTROL, targetVelocity=action[0], force=50, physicsClientId=self.cid
        )
        for _ in range(4):
            p.stepSimulation(physicsClientId=self.cid)

    def is_success(self):
        return bool(self.place()[0] > 1.0)

    def reward(self):
        return float(self.place()[0]) + 0.1 * self.touch()


class RamAny(Ram):
    def touch(self):
        return float(any(one[8] > 0.05 for one in self.points()))


class RamConstant(Ram):
    def touch(self):
        points = p.getContactPoints(bodyA=self.body, bodyB=self.box, linkIndexA=0, physicsClientId=self.cid) or ()
        for point in points:
            if point[8] >= FORCE:
                return 1.0
        return 0.0


class RamSum(Ram):
    least = 0.2

    def touch(self):
        contacts = self.points()
        total = sum([contact[8] for contact in contacts])
        return 1.0 if self.least < total else 0.0


class RamLargest(Ram):
    def touch(self):
        return float(max((c[8] for c in self.points()), default=0.0) > 1.0)


class RamApart(Ram):
    """Distances: those of the nearest points, and of contacts that do not press."""

    def touch(self):
        near = p.getClosestPoints(self.body, self.box, 1.0, physicsClientId=self.cid)
        far = [one for one in near if one[8] > 0.05]
        pressing = [one for one in self.points() if not one[8] > 0.0]
        depth = max([-one[8] for one in pressing], default=0.0)
        return float(len(pressing) > 0 and not far and depth < 0.1)


class RamForces(Ram):
    def touch(self):
        forces = [one[8] for one in self.points()]
        return float(np.sum(forces))


class RamForceSum(Ram):
    def contact_force(self):
        return sum(c[8] for c in self.points())

    def touch(self):
        return self.contact_force()


class RamTorqueAsSpeed(Ram):
    def joint(self):
        state = p.getJointState(self.body, 0, physicsClientId=self.cid)
        pos, vel = state[0], state[3]
        return pos, vel


class RamSpeeds(Ram):
    def joint(self):
        states = p.getJointStates(self.body, [0], physicsClientId=self.cid)
        q = np.array([state[0] for state in states])
        joint_velocities = np.array([state[3] for state in states])
        return q[0], joint_velocities[0]


class RL839RamSwapped(Ram):
    def joint(self):
        velocity, position, _, _ = p.getJointState(self.body, 0, physicsClientId=self.cid)
        return position, velocity


class RamTurnAsSpeed(Ram):
    def box_velocity(self):
        velocity = p.getBaseVelocity(self.box, physicsClientId=self.cid)
        lin_vel = np.array(velocity[1])
        return lin_vel[0], velocity[1][1]


class RamNormalAsPlace(Ram):
    def place(self):
        where = super().place()
        for contact in p.getContactPoints(self.box, self.floor, physicsClientId=self.cid):
            contact_position = contact[7]
            where = np.add(where, 0.01 * np.array(contact_position))
        return where


class RamOtherNames(Ram):
    """Fields that fit what they are called."""

    def touch(self):
        points = self.points()
        normal_force = sum(one[9] for one in points)
        friction_forces = [one[10] for one in points]
        distances = np.array([one[8] for one in points])
        normals = [one[7] for one in points]
        first_position = points[0][5] if points else (0, 0, 0)
        lin_pos, ang_pos = p.getBasePositionAndOrientation(self.box, physicsClientId=self.cid)
        tilt = 0.0 * (lin_pos[0] + ang_pos[0])
        return float(tilt + normal_force + sum(friction_forces) + distances.sum() + len(normals) + first_position[0])

    def joint(self):
        state = p.getJointState(self.body, 0, physicsClientId=self.cid)
        angle_rate, torque, pos = state[1], state[3], state[0]
        return pos + 0 * torque, angle_rate

    def box_velocity(self):
        velocity, omega = p.getBaseVelocity(self.box, physicsClientId=self.cid)
        vx = velocity[0]
        angular = np.array(omega)
        return vx, angular[1]

    def place(self):
        pos, orn = p.getBasePositionAndOrientation(self.box, physicsClientId=self.cid)
        tip = p.getLinkState(self.body, 0, computeLinkVelocity=1, physicsClientId=self.cid)
        tip_pos, tip_orientation = tip[4], tip[5]
        tip_linear, tip_angular = tip[6], tip[7]
        total = sum(orn[:3]) + tip_pos[1] + tip_orientation[0] + tip_linear[1] + tip_angular[1]
        return np.array(pos) + 0 * total
