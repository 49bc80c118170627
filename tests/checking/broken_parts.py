"""Boats whose action is cut off where its range goes on, and robots whose goals lie beyond what stops them, next to
twins."""

import mujoco
import numpy as np
from mujoco_robots import MujocoArm, MujocoRobot
from robots import Boat, Robot

RAIL = """
<mujoco><option timestep="0.01"/><worldbody><body>
  <joint name="rail" type="slide" axis="1 0 0" range="-.3 .3" damping="2"/>
  <geom type="sphere" size=".05" mass="1"/></body></worldbody>
<actuator><motor joint="rail" ctrlrange="-4 4"/></actuator></mujoco>
"""


class BoatWithAThrottle(Boat):
    """One element of the action is its throttle, the other one its rudder."""

    def throttle(self, action):
        return 0.5 * (action[0] + 1.0)

    def move(self, action):
        throttle = self.throttle(action)
        super().move(np.array([throttle + 0.5 * action[1], throttle - 0.5 * action[1]]))


class BoatForgetsToShift(BoatWithAThrottle):
    def throttle(self, action):
        return np.clip(action[0], 0.0, 1.0)


class BoatShiftsTooLittle(BoatWithAThrottle):
    def throttle(self, action):
        return max(0.6 * action[0] + 0.2, 0.0)


class BoatStartsItsEngine(BoatWithAThrottle):
    """Its engine stands still below the middle, and runs with half of its power at least above it."""

    def throttle(self, action):
        return 0.5 * (1.0 + np.clip(action[0], 0.0, 1.0)) if action[0] > 0.0 else 0.0


class BoatBrakes(BoatWithAThrottle):
    """The other half brakes."""

    def throttle(self, action):
        return np.clip(action[0], 0.0, 1.0) - 0.5 * np.clip(-action[0], 0.0, 1.0)


class BoatSaturates(BoatWithAThrottle):
    """Its gain is high, in both directions."""

    def throttle(self, action):
        return np.clip(3.0 * action[0], -1.0, 1.0)


class Carriage(MujocoRobot):
    """A carriage on a rail goes to a place that is drawn."""

    xml, joints, farthest = RAIL, 1, 0.28

    def start(self):
        self.goal = self.draw()
        self.data.qpos[0] = self.np_random.uniform(-0.2, 0.2)

    def draw(self):
        return self.np_random.uniform(-self.farthest, self.farthest)

    def move(self, action):
        self.data.ctrl[:] = 4 * action
        mujoco.mj_step(self.model, self.data, nstep=self.frames)

    def observe(self):
        return np.array([self.data.qpos[0], self.data.qvel[0], getattr(self, "goal", 0.0)])

    def error(self):
        return abs(self.data.qpos[0] - self.goal)

    def reward(self):
        return -self.error()

    def succeeds(self):
        return bool(self.error() < 0.02)


class CarriageOffItsRail(Carriage):
    farthest = 0.5


class Posed(MujocoArm):
    """An arm takes a pose that is drawn for its joints."""

    most = np.array([1.5, 1.5, 1.5])  # of shoulder, elbow and wrist [rad]

    def start(self):
        super().start()
        self.data.qpos[:] += self.np_random.uniform(-0.3, 0.3, 3)
        self.pose = self.np_random.uniform([-0.5, 0.0, -1.5], self.most)

    def reward(self):
        return -np.linalg.norm(self.data.qpos - self.pose)

    def succeeds(self):
        return bool(np.linalg.norm(self.data.qpos - self.pose) < 0.1)


class PosedBeyondItsElbow(Posed):
    most = np.array([1.5, 4.0, 1.5])


class Lift(Robot):
    """A lift between two floors goes to a height that is drawn."""

    joints, highest = 1, 1.0

    def start(self):
        self.height = self.np_random.uniform(0.2, 0.8)
        self.goal = self.np_random.uniform(0.0, self.highest)

    def size(self):
        return 2

    def observe(self):
        return np.array([self.height, self.goal], np.float32)

    def move(self, action):
        self.height = np.clip(self.height + 0.1 * action[0], 0.0, 1.0)

    def is_success(self):
        return bool(abs(self.height - self.goal) < 0.05)

    def reward(self):
        return -abs(self.height - self.goal)


class LiftAboveItsShaft(Lift):
    highest = 1.6
