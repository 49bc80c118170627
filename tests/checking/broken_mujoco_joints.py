"""Robots in MuJoCo that move the wrong joints, or observe joints with one mistake, next to the twins that do not."""

import mujoco
import numpy as np
from broken_turned import Cart
from mujoco_robots import ARM, MujocoArm, MujocoHopper, MujocoRobot

# RL804


class RL804ArmLimitsInRadians(MujocoArm):
    """Its compiler reads degrees."""

    rlctl_ignore = dict.fromkeys(("RL701", "RL611", "RL619", "RL816"), "a consequence")
    xml = ARM.replace("-60 150", "-1.05 2.62").replace("-20 140", "-0.35 2.44").replace("-170 170", "-2.97 2.97")


# RL811 and RL816


class ArmIncrements(MujocoArm):
    """Targets change by the action, from where the joints start: near zero, where all joints look alike."""

    home = np.zeros(3)
    gain = 0.15
    low, high = np.array([-1.04, -0.34, -2.96]), np.array([2.61, 2.44, 2.96])  # of shoulder, elbow and wrist

    def start(self):
        super().start()
        self.target = self.data.qpos.copy()

    def targets(self, action):
        self.target = np.clip(self.target + self.gain * action, self.low, self.high)
        return self.target


class RL811ArmIncrementsInOtherOrder(ArmIncrements):
    rlctl_ignore = {"RL804": "a consequence"}

    def __init__(self):
        super().__init__()
        self.motors = [0, 1, 2]


class RL816ArmIncrementsTooFar(ArmIncrements):
    """The ranges of the elbow and the wrist are those of the wrist."""

    rlctl_ignore = {"RL611": "hard to find"}
    low, high = np.array([-1.04, -2.96, -2.96]), np.array([2.61, 2.96, 2.96])


class CartSpeedsUp(Cart):
    """Each action changes the torques of its wheels, which are kept."""

    def start(self):
        super().start()
        self.torques = np.zeros(2)

    def change(self, action):
        self.torques = np.clip(self.torques + 0.05 * action, -1.0, 1.0)

    def move(self, action):
        self.change(action)
        super().move(self.torques)


class RL816CartSpeedsUpTooFar(CartSpeedsUp):
    def change(self, action):
        self.torques = self.torques + 0.05 * action


class HopperPushes(MujocoHopper):
    """Each action changes the torques of its legs, which are kept."""

    most = 12.0

    def start(self):
        super().start()
        self.kept = np.zeros(6)

    def torques(self, action):
        self.kept = np.clip(self.kept + 1.0 * action, -self.most, self.most)
        return self.kept

    def move(self, action):
        self.data.ctrl[:] = self.torques(action)
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()


class RL816HopperPushesTooFar(HopperPushes):
    most = 1e3


class ArmFollowsMeasured(ArmIncrements):
    """Targets are relative to where the joints are: beyond a range only while the action points there."""

    def targets(self, action):
        return self.data.qpos + 0.5 * action


class RL811HopperIncrements(MujocoHopper):
    """Torques that follow targets, which change by the action."""

    order = np.arange(6)

    def start(self):
        super().start()
        self.target = self.data.qpos[7:].copy()

    def torques(self, action):
        self.target = self.target + 0.02 * action
        return super().torques((self.target - self.home) / 0.4)[self.order]


class RL811HopperIncrementsInOtherOrder(RL811HopperIncrements):
    rlctl_ignore = dict.fromkeys(("RL117", "RL701", "RL803", "RL804", "RL805", "RL816"), "a consequence")
    order = np.array([1, 0, 2, 3, 4, 5])


class ArmResolvesMotion(MujocoArm):
    """A motion of the tip, by the Jacobian: every motor answers every joint."""

    def targets(self, action):
        jacobian = np.zeros((3, 3))
        mujoco.mj_jacSite(self.model, self.data, jacobian, None, self.model.site("tip").id)
        return self.data.qpos + 0.05 * jacobian.T @ action


# RL119, RL819 and RL820


class HopperObserves(MujocoHopper):
    def observe(self):
        return np.concatenate([super().observe(), self.joints_of(self.data.qpos[7:], self.data.qvel[6:])])

    def joints_of(self, positions, speeds):
        return [*(positions - self.home), *(0.1 * speeds)]


class RL119HopperInDegrees(HopperObserves):
    def joints_of(self, positions, speeds):
        return [*np.rad2deg(positions[:2]), *speeds]


class HopperAllInDegrees(MujocoHopper):
    """Nothing but degrees: a unit like another one."""

    def observe(self):
        return np.concatenate([np.rad2deg(self.data.qpos[7:]), np.rad2deg(self.data.qvel[6:])])


class RL819HopperSpeedsInOtherOrder(HopperObserves):
    def joints_of(self, positions, speeds):
        return super().joints_of(positions, speeds[[0, 2, 4, 1, 3, 5]])


class RL820ArmVelocity(MujocoArm):
    """Observes the velocity of the tip, from the tip of the step before."""

    def start(self):
        super().start()
        self.last = None

    def time(self):
        return self.model.opt.timestep * self.frames

    def observe(self):
        tip = self.tip().copy()
        velocity = np.zeros(3) if getattr(self, "last", None) is None else (tip - self.last) / self.time()
        self.last = tip
        return np.concatenate([self.data.qpos, velocity, self.goal - tip])


class RL820ArmVelocityOfSubsteps(RL820ArmVelocity):
    def time(self):
        return self.model.opt.timestep


# RL803: a physics that is never stepped


class RoverByPositions(MujocoRobot):
    """Its body reaches into the ground, and nothing pushes it out: it is placed, and contacts are only looked at."""

    xml = """
    <mujoco><option gravity="0 0 0"/><worldbody><geom name="ground" type="plane" size="9 9 1"/>
    <body name="rover"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <geom name="hull" type="cylinder" size=".2 .05" mass="5"/></body></worldbody></mujoco>
    """
    joints = 2

    def start(self):
        self.data.qpos[:] = self.np_random.uniform(-1, 1, 2)

    def move(self, action):
        self.data.qpos[:] += 0.02 * action
        self.forward()

    def observe(self):
        return self.data.qpos.copy()

    def reward(self):
        return -float(np.square(self.data.qpos).sum())

    def succeeds(self):
        return bool(np.abs(self.data.qpos).max() < 0.1)


class RL803RoverInTheGround(RoverByPositions):
    def move(self, action):
        self.data.qvel[:] = action
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()
