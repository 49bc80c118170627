"""Robots in MuJoCo with one mistake each, next to the twin that does the same thing right where it is not the robot."""

import mujoco
import numpy as np
from mujoco_robots import ARM, HOPPER, MujocoArm, MujocoHopper
from scipy.spatial.transform import Rotation

# RL116


class HopperQuaternion(MujocoHopper):
    rlctl_ignore = {"RL117": "a consequence"}

    def attitude(self):
        return Rotation.from_quat(self.data.qpos[3:7])


class HopperVelocity(MujocoHopper):
    def observe(self):
        w, x, y, z = self.data.qpos[3:7]
        forward = Rotation.from_quat([w, x, y, z]).inv().apply(self.data.qvel[:3])
        return np.concatenate([forward, self.data.qpos[7:], self.touches()])


class HopperRightVelocity(MujocoHopper):
    def observe(self):
        w, x, y, z = self.data.qpos[3:7]
        forward = Rotation.from_quat([x, y, z, w]).inv().apply(self.data.qvel[:3])
        return np.concatenate([forward, self.data.qpos[7:], self.touches()])


class HopperHeading(MujocoHopper):
    def turn(self):
        x, y, z, w = self.data.qpos[3:7]
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def observe(self):
        cosine, sine, (x, y) = np.cos(self.turn()), np.sin(self.turn()), self.data.qvel[:2]
        return np.array([cosine * x + sine * y, cosine * y - sine * x, *self.data.qpos[7:]])


class HopperRightHeading(HopperHeading):
    def turn(self):
        w, x, y, z = self.data.qpos[3:7]
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


class ArmQuaternion(MujocoArm):
    def observe(self):
        angles = Rotation.from_quat(self.data.body("hand").xquat).as_euler("xyz")
        return np.concatenate([super().observe(), angles])


class ArmRightQuaternion(ArmQuaternion):
    def observe(self):
        angles = Rotation.from_matrix(self.data.body("hand").xmat.reshape(3, 3)).as_euler("xyz")
        return np.concatenate([MujocoArm.observe(self), angles])


# RL804, RL805, RL807, RL813, RL814


class ArmBeyondLimits(MujocoArm):
    def start(self):
        super().start()
        self.data.qpos[1] = -0.9


class HopperExplodes(MujocoHopper):
    rlctl_ignore = {
        "RL603": "a consequence",
        "RL118": "a consequence",
        "RL610": "a consequence",
        "RL803": "a consequence",
    }
    gains = 30.0, 60.0
    xml = HOPPER.replace('ctrlrange="-12 12"', 'ctrlrange="-9000 9000"').replace('armature=".01"', 'armature=".0001"')

    def move(self, action):
        self.data.ctrl[:] = 100.0 * self.torques(action)
        mujoco.mj_step(self.model, self.data, nstep=5)
        self.forward()


class HopperInTheGround(MujocoHopper):
    rlctl_ignore = {"RL117": "a consequence", "RL610": "a consequence", "RL803": "a consequence"}

    def start(self):
        super().start()
        self.data.qpos[2] = 0.15


class ArmLongSteps(MujocoArm):
    frames = 1
    xml = ARM.replace('timestep="0.004"', 'timestep="0.025"')


class ArmWeakMotors(MujocoArm):
    xml = ARM.replace('forcerange="-60 60"', 'forcerange="-1 1"')


# RL810


class ArmDegrees(MujocoArm):
    rlctl_ignore = {"RL701": "a consequence", "RL804": "a consequence"}

    def targets(self, action):
        return np.degrees(super().targets(action))


class ArmRangeInDegrees(MujocoArm):
    rlctl_ignore = {"RL611": "a consequence"}

    def targets(self, action):
        low, high = np.radians(self.model.jnt_range.T)
        return low + (action + 1) / 2 * (high - low)


class ArmRange(MujocoArm):
    def targets(self, action):
        low, high = self.model.jnt_range.T
        return low + (action + 1) / 2 * (high - low)


class ArmRangeOfActuatorInDegrees(MujocoArm):
    xml = ARM.replace('ctrlrange="-1.04 2.61"', 'ctrlrange="-60 150"')


class ArmObservesRadiansOfRadians(MujocoArm):
    def observe(self):
        return np.concatenate([np.radians(self.data.qpos), self.data.qvel, self.goal - self.tip()])


class HopperStartsInDegrees(MujocoHopper):
    rlctl_ignore = {
        "RL610": "a consequence",
        "RL805": "a consequence",
        "RL118": "a consequence",
        "RL807": "a consequence",
        "RL603": "a consequence",
        "RL804": "a consequence",
        "RL803": "a consequence",
    }

    def start(self):
        super().start()
        self.data.qpos[8] = -57.0


# RL811


class ArmOrder(MujocoArm):
    rlctl_ignore = {"RL701": "a consequence"}

    def __init__(self):
        super().__init__()
        self.motors = [0, 1, 2]


class ArmOrderOfRanges(ArmRange):
    def __init__(self):
        super().__init__()
        self.motors = [0, 1, 2]


class HopperOrder(MujocoHopper):
    rlctl_ignore = {
        "RL701": "a consequence",
        "RL803": "a consequence",
        "RL804": "a consequence",
        "RL117": "a consequence",
    }

    def positions(self):
        return self.data.qpos[7:][[0, 2, 4, 1, 3, 5]]


# RL812


class HopperOtherSoles(MujocoHopper):
    rlctl_ignore = {"RL110": "a consequence"}
    soles = ("left_thigh", "right_thigh", "back_thigh")


class HopperThighs(MujocoHopper):
    def observe(self):
        soles, self.soles = self.soles, HopperOtherSoles.soles
        thighs = self.touches()
        self.soles = soles
        return np.concatenate([super().observe(), thighs])


class ArmTouchesWithPalm(MujocoArm):
    rlctl_ignore = {"RL611": "a consequence"}
    home = np.array([1.6, 1.2, 0.3])
    part = "palm"

    def __init__(self):
        super().__init__()
        self.part_id = self.model.geom(self.part).id

    def reward(self):
        return super().reward() - 1.0 * any(self.part_id in contact.geom for contact in self.data.contact)


class ArmTouchesWithFinger(ArmTouchesWithPalm):
    part = "finger"


# RL815


class ArmOldTip(MujocoArm):
    def move(self, action):
        self.data.ctrl[self.motors] = self.targets(action)
        mujoco.mj_step(self.model, self.data, nstep=5)


class ArmOldSensor(ArmOldTip):
    def tip(self):
        return self.data.sensordata[:3]


class ArmRightSensor(MujocoArm):
    def tip(self):
        return self.data.sensordata[:3]


class ArmResetsWithoutForward(MujocoArm):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.start()
        return self.observe().astype(np.float32), {}


class ArmForwardTooEarly(MujocoArm):
    def forward(self):
        super().forward()
        if self.data.time == 0:
            self.data.qpos[0] += 0.2


class HopperStateInTheLoop(MujocoHopper):
    def move(self, action):
        self.height = None
        for _ in range(5):
            self.height = self.data.qpos[2:7].copy()
            self.data.ctrl[:] = np.clip(self.torques(action), -12.0, 12.0)
            mujoco.mj_step(self.model, self.data)
        self.forward()

    def observe(self):
        height = self.data.qpos[2:7] if getattr(self, "height", None) is None else self.height
        return np.concatenate([height, self.data.qpos[7:], self.touches()])

    def start(self):
        super().start()
        self.height = None


# RL816


class ArmBeyondRange(MujocoArm):
    rlctl_ignore = {"RL805": "a consequence"}
    home, gain = np.zeros(3), 4.0


class HopperTorqueBeyondRange(MujocoHopper):
    def move(self, action):
        self.data.ctrl[:] = 30.0 * action
        mujoco.mj_step(self.model, self.data, nstep=5)
        self.forward()


class HopperTorque(HopperTorqueBeyondRange):
    def move(self, action):
        super().move(0.4 * action)


# RL817


class ArmGrowsHeavy(MujocoArm):
    rlctl_ignore = {"RL302": "a consequence"}

    def start(self):
        super().start()
        self.model.body_mass[:] *= self.np_random.uniform(0.8, 1.2)


class ArmNominalMass(MujocoArm):
    def __init__(self):
        super().__init__()
        self.mass = self.model.body_mass.copy()

    def start(self):
        super().start()
        self.model.body_mass[:] = self.mass * self.np_random.uniform(0.8, 1.2)


class HopperSlips(MujocoHopper):
    rlctl_ignore = {"RL302": "a consequence"}

    def start(self):
        super().start()
        self.model.geom_friction[0, 0] *= self.np_random.uniform(0.7, 1.3)


class HopperFriction(MujocoHopper):
    def start(self):
        super().start()
        self.model.geom_friction[0, 0] = self.np_random.uniform(0.7, 1.3)


# RL818


class HopperForces(MujocoHopper):
    rlctl_ignore = {"RL110": "a consequence"}

    def observe(self):
        return np.concatenate([super().observe(), np.clip(self.data.cfrc_ext[1:].ravel(), -1, 1)])


class HopperRightForces(HopperForces):
    def move(self, action):
        super().move(action)
        mujoco.mj_rnePostConstraint(self.model, self.data)


class ArmInverse(MujocoArm):
    def reward(self):
        return super().reward() - 0.001 * np.abs(self.data.qfrc_inverse).sum()


class ArmActuator(MujocoArm):
    def reward(self):
        return super().reward() - 0.001 * np.abs(self.data.qfrc_actuator).sum()


# RL301, RL302


class ArmKeepsActivation(MujocoArm):
    xml = ARM.replace('<position name="bend"', '<position timeconst=".2" name="bend"')

    def clear(self):
        self.data.qpos[:], self.data.qvel[:] = self.model.qpos0, 0.0


class ArmResets(ArmKeepsActivation):
    def clear(self):
        mujoco.mj_resetData(self.model, self.data)


class HopperKeepsTime(MujocoHopper):
    def clear(self):
        self.data.qpos[:], self.data.qvel[:], self.data.qacc_warmstart[:] = self.model.qpos0, 0.0, 0.0

    def observe(self):
        return np.append(super().observe(), np.sin(self.data.time))


class HopperResets(HopperKeepsTime):
    def clear(self):
        mujoco.mj_resetData(self.model, self.data)
