"""Robots that see a direction that is fixed in the world, and velocities in their own frame, next to their twins."""

import mujoco
import numpy as np
import pybullet as p
from broken_meaning import Robot
from broken_turned import FLYER, Free, Puck
from scipy.spatial.transform import Rotation


class Satellite(Robot):
    """It turns towards a star whose direction it sees, with noise; its quaternion is x, y, z, w, body to world."""

    rlctl_ignore = {"RL611": "it is hard to find"}
    numbers, noise, dt = 3, 0.01, 0.1

    def start(self):
        self.attitude = Rotation.random(random_state=self.np_random).as_quat()
        self.star = Rotation.random(random_state=self.np_random).apply([1.0, 0.0, 0.0])
        self.rates = self.np_random.uniform(-0.2, 0.2, 3)

    def rotation(self):
        return Rotation.from_quat(self.attitude)

    def move(self, action):
        self.rates = self.rates + self.dt * (1.5 * action - 0.3 * self.rates)
        self.attitude = (self.rotation() * Rotation.from_rotvec(self.dt * self.rates)).as_quat()

    def seen(self):
        return self.rotation().inv().apply(self.star)

    def observe(self):
        return np.array([*self.rates, *(self.seen() + self.np_random.normal(0, self.noise, 3))], np.float32)

    def distance(self):
        return float(1.0 - self.rotation().inv().apply(self.star)[2])

    def reward(self, action):
        return -self.distance()


class RL124SatelliteStar(Satellite):
    def seen(self):
        return self.rotation().apply(self.star)


class SatelliteOfMatrix(Satellite):
    """It has the matrix from the world to the body, and sees no noise."""

    noise = 0.0

    def start(self):
        vars(self).pop("matrix", None)
        super().start()
        self.matrix = self.rotation().inv().as_matrix()
        del self.attitude

    def rotation(self):
        return Rotation.from_matrix(self.matrix.T) if hasattr(self, "matrix") else Rotation.from_quat(self.attitude)

    def move(self, action):
        self.rates = self.rates + self.dt * (1.5 * action - 0.3 * self.rates)
        self.matrix = (self.rotation() * Rotation.from_rotvec(self.dt * self.rates)).inv().as_matrix()

    def seen(self):
        return self.matrix @ self.star


class RL124SatelliteOfMatrixStar(SatelliteOfMatrix):
    def seen(self):
        return self.matrix.T @ self.star


class Probe(Free):
    """A free body in MuJoCo that tumbles, and sees its velocities and a beacon far away."""

    rlctl_ignore = {"RL306": "it does not see its heading", "RL801": "it is in space"}
    xml = FLYER.replace('timestep="0.005"', 'timestep="0.005" gravity="0 0 0"')

    def start(self):
        self.heading = 0.0
        self.data.qpos[:3] = self.np_random.uniform(-1, 1, 3)
        self.data.qpos[3:7] = Rotation.random(random_state=self.np_random).as_quat(scalar_first=True)
        self.data.qvel[:] = self.np_random.uniform(-0.5, 0.5, 6)
        self.beacon = Rotation.random(random_state=self.np_random).apply([1.0, 0.0, 0.0])

    def move(self, action):
        self.data.ctrl[:] = [3.0 * action[0], 2.0 * action[1], 0.1 * action[2]]
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()

    def seen(self):
        return self.turn().inv().apply(self.beacon)

    def velocity(self):
        return self.turn().inv().apply(self.data.qvel[:3])

    def observe(self):
        beacon = self.seen() if hasattr(self, "beacon") else np.zeros(3)
        place = self.turn().inv().apply(self.data.qpos[:3])
        return np.concatenate([place, self.velocity(), self.data.qvel[3:], beacon])


class RL124ProbeBeacon(Probe):
    rlctl_ignore = {
        **Probe.rlctl_ignore,
        "RL125": "the same elements once more",
        "RL701": "its motor pushes in one direction",
    }

    def seen(self):
        return self.turn().apply(self.beacon)


class RL130ProbePoint(Probe):
    rlctl_ignore = {**Probe.rlctl_ignore, "RL701": "the tumbling hides a weak action"}

    def velocity(self):
        return self.turn().inv().apply(self.data.qvel[:3] - self.data.qpos[:3])


class PuckWithPlace(Puck):
    """A disc on ice in PyBullet that sees where it is and how fast, in its own frame."""

    def into(self, vector, origin):
        return self.look()[0].inv().apply(np.asarray(vector) - origin)[:2]

    def seen(self):
        return self.into(self.look()[1], np.zeros(3))

    def observe(self):
        place, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        turn = self.look()[0].as_matrix()[:2, 0]
        return np.array([*place[:2], *turn, *(0.5 * self.seen()), self.look()[2][2]], np.float32)

    def size(self):
        return 7


class RL130PuckPoint(PuckWithPlace):
    def seen(self):
        place, _ = p.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        return self.into(self.look()[1], place)


class Boat(Robot):
    """A boat without an engine that sees how fast a buoy drifts, in its own frame."""

    dt = 0.1

    def start(self):
        self.place, self.velocity = self.np_random.uniform(-1, 1, 2), np.zeros(2)
        self.heading = self.np_random.uniform(-3, 3)
        self.buoy, self.drift = self.np_random.uniform(-2, 2, 2), self.np_random.uniform(-0.5, 0.5, 2)

    def move(self, action):
        self.heading += self.dt * 2.0 * action[1]
        ahead = np.array([np.cos(self.heading), np.sin(self.heading)])
        self.velocity = self.velocity + self.dt * (3.0 * action[0] * ahead - self.velocity)
        self.place = self.place + self.dt * self.velocity
        self.drift = self.drift - self.dt * 0.3 * self.buoy
        self.buoy = self.buoy + self.dt * self.drift

    def into(self, vector):
        cosine, sine = np.cos(self.heading), np.sin(self.heading)
        return np.array([[cosine, sine], [-sine, cosine]]) @ vector

    def point(self, point):
        return self.into(point - self.place)

    def drifts(self):
        return self.into(self.drift)

    def observe(self):
        return np.array([*self.point(self.buoy), *self.into(self.velocity), *self.drifts()], np.float32)

    def distance(self):
        return float(np.linalg.norm(self.buoy - self.place))

    def reward(self, action):
        return -self.distance()


class RL130BoatPoint(Boat):
    def drifts(self):
        return self.point(self.drift)
