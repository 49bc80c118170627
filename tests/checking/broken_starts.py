"""Boats that keep something of the episode before, whose buoy is where they start or is drawn in vain, that read a
quaternion in the wrong order, and hoppers that call a part by another name; next to twins that do not."""

import mujoco
import numpy as np
from mujoco_robots import MujocoHopper
from robots import Boat
from scipy.spatial.transform import Rotation


class BoatTows(Boat):
    """It hooks a raft when it is very near, and is paid for towing it."""

    def __init__(self):
        self.hooked, self.rope = False, {"taut": 0.0}
        super().__init__()

    def start(self):
        super().start()
        self.raft = self.place + self.np_random.uniform(-0.9, 0.9, 2)
        self.let_go()

    def let_go(self):
        self.hooked = False
        self.rope["taut"] = 0.0

    def move(self, action):
        super().move(action)
        self.hook()
        if self.hooked:
            self.raft = self.place.copy()

    def is_near(self):
        return np.linalg.norm(self.raft - self.place) < 0.002

    def hook(self):
        if self.is_near():
            self.hooked = True
            self.rope["taut"] += 0.1

    def reward(self):
        return super().reward() + 0.01 * self.hooked + 0.001 * min(self.rope["taut"], 1.0)


class RL644BoatTowsFromTheStart(BoatTows):
    def let_go(self):
        self.rope["taut"] = 0.0


class RL644BoatTowsWithATautRope(BoatTows):
    def let_go(self):
        self.hooked = False


class BoatLightsUp(Boat):
    """Its lamp is on near the middle, and stays so after a reset: that is only seen."""

    def __init__(self):
        self.is_lit = False
        super().__init__()

    def render(self): ...

    def shine(self):
        if self.is_lit:
            self.render()

    def power(self):
        return 1.0

    def move(self, action):
        super().move(self.power() * action)
        self.shine()
        if np.linalg.norm(self.place) < 0.002:
            self.is_lit = True


class BoatSlowsDown(BoatLightsUp):
    """Its lamp takes the power of its motor."""

    def power(self):
        return 0.9 if self.is_lit else 1.0


class BoatToItsAim(Boat):
    """It goes to a target near the shore."""

    def start(self):
        super().start()
        self.target = self.place + self.np_random.uniform(-0.6, 0.6, 2)
        self.target = np.clip(self.target, -1.6, 1.6)

    def observe(self):
        c, s = np.cos(self.heading), np.sin(self.heading)
        x, y = self.target - self.place
        return np.array([c * x + s * y, c * y - s * x, s, c, *self.speed], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.target - self.place))


class RL610BoatFloatsAtItsAim(BoatToItsAim):
    rlctl_ignore = {"RL504": "a consequence"}

    def start(self):
        super().start()
        self.target = self.place.copy()


class RL306BoatToOneAim(BoatToItsAim):
    def start(self):
        Boat.start(self)
        self.target = self.place + self.np_random.uniform(-0.6, 0.6, 2)
        self.target = np.array([0.3, 0.2])


class RL306BoatOfOneGenerator(BoatToItsAim):
    """Only the noise of its start is another one."""

    def start(self):
        super().start()
        generator = np.random.default_rng(7)
        self.place = generator.uniform(-1, 1, 2) + self.np_random.normal(0, 0.01, 2)
        self.target = self.place + generator.uniform(-0.6, 0.6, 2)


class BoatWithAGyro(Boat):
    """It reads its heading from the quaternion of a sensor."""

    def yaw(self):
        x, y, z, w = Rotation.from_euler("z", self.heading).as_quat()
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def observe(self):
        shown = super().observe()
        shown[2:4] = np.sin(self.yaw()), np.cos(self.yaw())
        return shown


class RL116BoatWithAGyroReadAsWxyz(BoatWithAGyro):
    def yaw(self):
        w, x, y, z = Rotation.from_euler("z", self.heading).as_quat()
        return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


class BoatReadsItsGyroTwice(RL116BoatWithAGyroReadAsWxyz):
    def observe(self):
        shown = super().observe()
        w, x, y, z = Rotation.from_euler("z", self.heading).as_quat()
        shown[3] = w * w + x * x - y * y - z * z
        return shown


class HopperOfItsSoles(MujocoHopper):
    """It is paid a little for how high one sole is."""

    def reward(self):
        return super().reward() + 0.01 * self.height()

    def height(self):
        left_sole = self.data.geom("left_sole")
        return float(left_sole.xpos[2])


class RL841HopperOfTheOtherSole(HopperOfItsSoles):
    def height(self):
        left_sole = self.data.geom("right_sole")
        return float(left_sole.xpos[2])


class RL841HopperOfItsShin(HopperOfItsSoles):
    def height(self):
        sole, foot = self.data.geom("left_sole"), self.data.body("left_shin")
        return float(sole.xpos[2] + 0.0 * foot.xpos[2])


class HopperOfForces(MujocoHopper):
    """It pays for the force of its soles on the ground, and for its tilt."""

    def up(self):
        return self.attitude().inv().apply([0.0, 0.0, 1.0])

    def tilt(self):
        return np.sum(self.up()[:2] ** 2)

    def pressure(self):
        total, force = 0.0, np.zeros(6)
        for number in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, number, force)
            total += force[0]
        return total

    def reward(self):
        return super().reward() - 0.001 * self.pressure() - 0.3 * self.tilt()


class RL621HopperOfForcesLeans(HopperOfForces):
    def tilt(self):
        return np.sum(self.up()[2:] ** 2)


class RL839HopperOfForcesSideways(HopperOfForces):
    def pressure(self):
        total, force = 0.0, np.zeros(6)
        for number in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, number, force)
            total += force[2]
        return total


class HopperOfFriction(HopperOfForces):
    """It pays for the friction of its soles."""

    def pressure(self):
        total, force = 0.0, np.zeros(6)
        for number in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, number, force)
            total += np.hypot(force[1], force[2])
        return total
