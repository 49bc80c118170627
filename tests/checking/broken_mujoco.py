"""Robots in MuJoCo with one mistake each, next to the twin that does the same thing right where it is not the robot."""

import re

import mujoco
import numpy as np
from gymnasium import spaces
from mujoco_robots import ARM, HOPPER, SIDES, MujocoArm, MujocoHopper
from scipy.spatial.transform import Rotation

# RL103


class ArmSpaceOfRanges(MujocoArm):
    """Its wrist has no limits, and its space takes each range from the model."""

    xml = ARM.replace('axis="1 0 0" range="-170 170"', 'axis="1 0 0"')

    def __init__(self):
        super().__init__()
        bounds = np.concatenate([self.list_ranges(), np.full((6, 2), [-np.inf, np.inf])]).astype(np.float32)
        self.observation_space = spaces.Box(*bounds.T)

    def list_ranges(self):
        return self.model.jnt_range


class ArmSpaceOfLimits(ArmSpaceOfRanges):
    def list_ranges(self):
        is_limited = self.model.jnt_limited.astype(bool)[:, None]
        return np.where(is_limited, self.model.jnt_range, [-np.inf, np.inf])


# RL116


class RL116HopperQuaternion(MujocoHopper):
    rlctl_ignore = {"RL117": "a consequence"}

    def attitude(self):
        return Rotation.from_quat(self.data.qpos[3:7])


class RL116HopperVelocity(MujocoHopper):
    def observe(self):
        w, x, y, z = self.data.qpos[3:7]
        forward = Rotation.from_quat([w, x, y, z]).inv().apply(self.data.qvel[:3])
        return np.concatenate([forward, self.data.qpos[7:], self.touches()])


class RL116HopperRightVelocity(MujocoHopper):
    def observe(self):
        w, x, y, z = self.data.qpos[3:7]
        forward = Rotation.from_quat([x, y, z, w]).inv().apply(self.data.qvel[:3])
        return np.concatenate([forward, self.data.qpos[7:], self.touches()])


class RL116HopperHeading(MujocoHopper):
    def turn(self):
        x, y, z, w = self.data.qpos[3:7]
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def observe(self):
        cosine, sine, (x, y) = np.cos(self.turn()), np.sin(self.turn()), self.data.qvel[:2]
        return np.array([cosine * x + sine * y, cosine * y - sine * x, *self.data.qpos[7:]])


class RL116HopperRightHeading(RL116HopperHeading):
    def turn(self):
        w, x, y, z = self.data.qpos[3:7]
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


class RL116ArmQuaternion(MujocoArm):
    def observe(self):
        angles = Rotation.from_quat(self.data.body("hand").xquat).as_euler("xyz")
        return np.concatenate([super().observe(), angles])


class RL116ArmRightQuaternion(RL116ArmQuaternion):
    def observe(self):
        angles = Rotation.from_matrix(self.data.body("hand").xmat.reshape(3, 3)).as_euler("xyz")
        return np.concatenate([MujocoArm.observe(self), angles])


# RL804, RL805, RL807, RL813, RL814


class RL804ArmBeyondLimits(MujocoArm):
    def start(self):
        super().start()
        self.data.qpos[1] = -0.9


class RL805HopperExplodes(MujocoHopper):
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


class RL807HopperInTheGround(MujocoHopper):
    rlctl_ignore = {"RL117": "a consequence", "RL610": "a consequence", "RL803": "a consequence"}

    def start(self):
        super().start()
        self.data.qpos[2] = 0.15


class RL813ArmLongSteps(MujocoArm):
    frames = 1
    xml = ARM.replace('timestep="0.004"', 'timestep="0.025"')


class RL814ArmWeakMotors(MujocoArm):
    xml = ARM.replace('forcerange="-60 60"', 'forcerange="-1 1"')


# RL810


class RL810ArmDegrees(MujocoArm):
    rlctl_ignore = {"RL701": "a consequence", "RL804": "a consequence"}

    def targets(self, action):
        return np.degrees(super().targets(action))


class RL810ArmRangeInDegrees(MujocoArm):
    rlctl_ignore = {"RL611": "a consequence"}

    def targets(self, action):
        low, high = np.radians(self.model.jnt_range.T)
        return low + (action + 1) / 2 * (high - low)


class ArmRange(MujocoArm):
    def targets(self, action):
        low, high = self.model.jnt_range.T
        return low + (action + 1) / 2 * (high - low)


class RL810ArmRangeOfActuatorInDegrees(MujocoArm):
    xml = ARM.replace('ctrlrange="-1.04 2.61"', 'ctrlrange="-60 150"')


class RL810ArmDrivesRangesInDegrees(MujocoArm):
    """Its actions cover the ranges of the model, which are in degrees."""

    rlctl_ignore = {"RL804": "a consequence", "RL805": "a consequence", "RL118": "a consequence"}
    xml = re.sub('ctrlrange="[^"]*"', 'ctrlrange="-50 120"', ARM).replace('range="-20 140"', 'range="-60 140"')

    def targets(self, action):
        low, high = self.model.actuator_ctrlrange[self.motors].T
        return low + (action + 1) / 2 * (high - low)


class HopperHolds(MujocoHopper):
    """Its actuators hold positions, and get targets."""

    xml = HOPPER.replace("<motor ", '<position kp="30" ').replace('ctrlrange="-12 12"', 'ctrlrange="-1.5 1.5"')

    def move(self, action):
        self.data.ctrl[:] = self.home + 0.4 * action
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()


class RL810HopperRangesInDegrees(HopperHolds):
    rlctl_ignore = {"RL706": "a consequence"}
    xml = HopperHolds.xml.replace('ctrlrange="-1.5 1.5"', 'ctrlrange="-90 30"')


class RL810ArmObservesRadiansOfRadians(MujocoArm):
    rlctl_ignore = {"RL132": "the same line once more"}

    def observe(self):
        return np.concatenate([np.radians(self.data.qpos), self.data.qvel, self.goal - self.tip()])


class RL810HopperStartsInDegrees(MujocoHopper):
    rlctl_ignore = {
        "RL610": "a consequence",
        "RL805": "a consequence",
        "RL118": "a consequence",
        "RL807": "a consequence",
        "RL603": "a consequence",
        "RL804": "a consequence",
        "RL803": "a consequence",
        "RL124": "a consequence",
    }

    def start(self):
        super().start()
        self.data.qpos[8] = -57.0


# RL811


class RL811ArmOrder(MujocoArm):
    rlctl_ignore = {"RL701": "a consequence"}

    def __init__(self):
        super().__init__()
        self.motors = [0, 1, 2]


class RL811ArmOrderOfRanges(ArmRange):
    def __init__(self):
        super().__init__()
        self.motors = [0, 1, 2]


class RL811HopperOrder(MujocoHopper):
    rlctl_ignore = {
        "RL701": "a consequence",
        "RL803": "a consequence",
        "RL804": "a consequence",
        "RL117": "a consequence",
    }

    def positions(self):
        return self.data.qpos[7:][[0, 2, 4, 1, 3, 5]]


# RL812


class RL812HopperOtherSoles(MujocoHopper):
    rlctl_ignore = {"RL110": "a consequence"}
    soles = ("left_thigh", "right_thigh", "back_thigh")


class RL812HopperThighs(MujocoHopper):
    def observe(self):
        soles, self.soles = self.soles, RL812HopperOtherSoles.soles
        thighs = self.touches()
        self.soles = soles
        return np.concatenate([super().observe(), thighs])


class RL812ArmTouchesWithPalm(MujocoArm):
    rlctl_ignore = {"RL611": "a consequence"}
    home = np.array([1.6, 1.2, 0.3])
    part, weight = "palm", 1.0

    def __init__(self):
        super().__init__()
        self.part_id = self.model.geom(self.part).id

    def reward(self):
        return super().reward() + self.weight * any(self.part_id in contact.geom for contact in self.data.contact)


class RL812ArmTouchesWithFinger(RL812ArmTouchesWithPalm):
    part = "finger"


class ArmPalmMustNotTouch(RL812ArmTouchesWithPalm):
    weight = -1.0


class HopperFalls(MujocoHopper):
    """It sees whether its trunk touches the ground, and not whether its feet do."""

    soles = ("box",)


# RL815


class RL815ArmOldTip(MujocoArm):
    def move(self, action):
        self.data.ctrl[self.motors] = self.targets(action)
        mujoco.mj_step(self.model, self.data, nstep=5)


class ArmOldTipInParts(RL815ArmOldTip):
    """It observes a dictionary, whose own order is not that of its space."""

    def __init__(self):
        super().__init__()
        parts = {"goal": 3, "joints": 6}.items()
        self.observation_space = spaces.Dict({n: spaces.Box(-np.inf, np.inf, (size,), np.float32) for n, size in parts})

    def split(self, observation):
        return {"joints": observation[:6], "goal": observation[6:]}

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return self.split(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.split(observation), *rest


class ArmOldTipSteers(RL815ArmOldTip):
    """Its controller reads where the tip is, too."""

    def targets(self, action):
        return super().targets(action) + 0.1 * (self.goal - self.tip())


class ArmSteers(MujocoArm):
    def targets(self, action):
        return super().targets(action) + 0.1 * (self.goal - self.tip())


class ArmOldTipAtRandom(RL815ArmOldTip):
    def start(self):
        super().start()
        self.data.qpos[0] += 0.01 * np.random.default_rng().standard_normal()


class ArmOldTipOfGlobalDraws(RL815ArmOldTip):
    def start(self):
        super().start()
        self.data.qpos[0] += 0.01 * np.random.standard_normal()  # noqa: NPY002


class RL815ArmOldSensor(RL815ArmOldTip):
    def tip(self):
        return self.data.sensordata[:3]


class RL815ArmRightSensor(MujocoArm):
    def tip(self):
        return self.data.sensordata[:3]


class RL815ArmResetsWithoutForward(MujocoArm):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.start()
        return self.observe().astype(np.float32), {}


class RL815ArmForwardTooEarly(MujocoArm):
    def forward(self):
        super().forward()
        if self.data.time == 0:
            self.data.qpos[0] += 0.2


class RL815HopperStateInTheLoop(MujocoHopper):
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


class RL816ArmBeyondRange(MujocoArm):
    rlctl_ignore = {"RL805": "a consequence"}
    home, gain = np.zeros(3), 4.0


class ArmWithJet(MujocoArm):
    """Another actuator, the first one, pushes a site."""

    xml = ARM.replace("<actuator>", '<actuator><general name="jet" site="tip" gear="0 0 1 0 0 0" ctrlrange="0 1"/>')


class RL816ArmWithJetBeyondRange(ArmWithJet):
    rlctl_ignore = {"RL805": "a consequence"}
    home, gain = np.zeros(3), 4.0


class RL816HopperTorqueBeyondRange(MujocoHopper):
    def move(self, action):
        self.data.ctrl[:] = 30.0 * action
        mujoco.mj_step(self.model, self.data, nstep=5)
        self.forward()


class RL816HopperTorque(RL816HopperTorqueBeyondRange):
    def move(self, action):
        super().move(0.4 * action)


# RL817


class RL817ArmGrowsHeavy(MujocoArm):
    rlctl_ignore = {"RL302": "a consequence"}

    def start(self):
        super().start()
        self.model.body_mass[:] *= self.np_random.uniform(0.8, 1.2)


class RL817ArmNominalMass(MujocoArm):
    def __init__(self):
        super().__init__()
        self.mass = self.model.body_mass.copy()

    def start(self):
        super().start()
        self.model.body_mass[:] = self.mass * self.np_random.uniform(0.8, 1.2)


class RL817HopperSlips(MujocoHopper):
    rlctl_ignore = {"RL302": "a consequence"}

    def start(self):
        super().start()
        self.model.geom_friction[0, 0] *= self.np_random.uniform(0.7, 1.3)


class RL817HopperFriction(MujocoHopper):
    def start(self):
        super().start()
        self.model.geom_friction[0, 0] = self.np_random.uniform(0.7, 1.3)


# RL818


class RL818HopperForces(MujocoHopper):
    rlctl_ignore = {"RL110": "a consequence"}

    def observe(self):
        return np.concatenate([super().observe(), np.clip(self.data.cfrc_ext[1:].ravel(), -1, 1)])


class RL818HopperRightForces(RL818HopperForces):
    def move(self, action):
        super().move(action)
        mujoco.mj_rnePostConstraint(self.model, self.data)


class RL818ArmInverse(MujocoArm):
    def reward(self):
        return super().reward() - 0.001 * np.abs(self.data.qfrc_inverse).sum()


class RL818ArmActuator(MujocoArm):
    def reward(self):
        return super().reward() - 0.001 * np.abs(self.data.qfrc_actuator).sum()


# RL301, RL302


class RL302ArmKeepsActivation(MujocoArm):
    xml = ARM.replace('<position name="bend"', '<position timeconst=".2" name="bend"')

    def clear(self):
        self.data.qpos[:], self.data.qvel[:] = self.model.qpos0, 0.0


class RL302ArmResets(RL302ArmKeepsActivation):
    def clear(self):
        mujoco.mj_resetData(self.model, self.data)


class RL301HopperKeepsTime(MujocoHopper):
    def clear(self):
        self.data.qpos[:], self.data.qvel[:], self.data.qacc_warmstart[:] = self.model.qpos0, 0.0, 0.0

    def observe(self):
        return np.append(super().observe(), np.sin(self.data.time))


class RL301HopperResets(RL301HopperKeepsTime):
    def clear(self):
        mujoco.mj_resetData(self.model, self.data)


class ArmKeepsSpeed(MujocoArm):
    """Sets its positions at reset, and nothing else."""

    def clear(self): ...


class HopperKeepsPlace(MujocoHopper):
    """Observes where it is on the ground, where it continues after a reset."""

    def clear(self):
        self.kept = self.data.qpos[:2].copy()
        super().clear()

    def start(self):
        super().start()
        self.data.qpos[:2] = self.kept

    def observe(self):
        return np.append(super().observe(), self.data.qpos[:2])


class ArmKeepsActivation(RL302ArmKeepsActivation):
    """Observes the state of its actuator."""

    def observe(self):
        return np.append(super().observe(), self.data.act)


class ArmKeepsMocap(MujocoArm):
    """Moves a body that is placed by hand, and leaves it there."""

    xml = ARM.replace("</worldbody>", '<body name="marker" mocap="true"/></worldbody>')

    def clear(self):
        kept = self.data.mocap_pos.copy()
        super().clear()
        self.data.mocap_pos[:] = kept

    def move(self, action):
        self.data.mocap_pos[0] += 0.1 * action
        super().move(action)

    def observe(self):
        return np.append(super().observe(), self.data.mocap_pos)


class HopperFeels(MujocoHopper):
    """A foot touches the ground where a force of more than 2 N acts on it."""

    def touches(self):
        self.compute_forces()
        feet = [self.model.body(f"{side}_foot").id for side in SIDES]
        return np.linalg.norm(self.data.cfrc_ext[feet, 3:], axis=1) > 2.0

    def compute_forces(self):
        mujoco.mj_rnePostConstraint(self.model, self.data)


class RL818HopperFeelsNothing(HopperFeels):
    rlctl_ignore = {"RL110": "a consequence"}

    def compute_forces(self):
        pass


class ArmFeels(MujocoArm):
    """Pays for a hard blow against its hand."""

    def reward(self):
        self.compute_forces()
        force = np.linalg.norm(self.data.cfrc_int[self.model.body("hand").id, 3:])
        return super().reward() - 0.5 * (force > 20.0)

    def compute_forces(self):
        mujoco.mj_rnePostConstraint(self.model, self.data)


class RL818ArmFeelsNothing(ArmFeels):
    def compute_forces(self):
        pass


class ArmGrowsHeavyAndRemembers(RL817ArmGrowsHeavy):
    """Keeps its last targets, which nothing reads."""

    rlctl_ignore = {}

    def targets(self, action):
        self.last_targets = super().targets(action)
        return self.last_targets
