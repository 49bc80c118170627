"""Robots whose headings are hidden, or in which a substep or an old entry is used wrongly; next to their twins."""

import os
import tempfile
from collections import deque

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces


def level(vector, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], *vector[2:]])


def box(size):
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


class Swimmer(gym.Env):
    """What both share: a place, a heading, and a goal that is paid by progress."""

    rlctl_ignore = {"RL611": "chance does not reach its goal", "RL619": "it swims without an end"}
    control_dt, substeps, size, gain = 0.1, 5, 2, 1.0

    def __init__(self):
        self.action_space = spaces.Box(-1.0, 1.0, (self.size,), np.float32)
        self.observation_space = self.space()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.uniform
        self.place = draw(-1, 1, self.size)
        self.heading, self.turning, self.steps = draw(-np.pi, np.pi), 0.0, 0
        self.velocity, self.forwards = np.zeros(self.size), 0.0
        away = np.array([draw(2, 4), 0.0, draw(-1, 1)])
        self.goal = self.place + level(away, draw(-np.pi, np.pi))[: self.size]
        self.fixes = deque([self.place.copy()] * 12, maxlen=12)
        self.gap = self.distance()
        return self.observe(), {}

    def distance(self):
        return float(np.linalg.norm(self.goal - self.fixes[self.fix()]))

    def fix(self):
        return -1

    def way(self):
        return level(self.goal - self.place, -self.heading)

    def speed(self):
        return level(self.velocity, -self.heading)

    def time(self):
        return self.control_dt / self.substeps

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(action, float), -1, 1)
        h = self.control_dt / self.substeps
        for _ in range(self.substeps):
            self.forwards += (1.2 * a[0] - self.forwards) * h / 0.3
            self.turning += (1.5 * a[1] - self.turning) * h / 0.25
            self.heading += self.turning * h
            self.velocity = self.drift(a)
            self.place = self.place + self.velocity * self.time()
        self.fixes.append(self.place.copy())
        gap = self.distance()
        reward = self.gain * (self.gap - gap) - 0.01 * float(a @ a)
        self.gap = gap
        self.steps += 1
        near = gap < 0.3
        return self.observe(), float(reward + 3.0 * near), near, self.steps >= 200 and not near, {"is_success": near}


class Tug(Swimmer):
    """In the plane; a flat observation."""

    def space(self):
        return box(6)

    def drift(self, a):
        side = 0.2 * self.forwards * self.turning
        return level(np.array([self.forwards, -side]), self.heading)

    def observe(self):
        return np.array([*self.way(), *self.speed(), self.turning, self.forwards], np.float32)


class Glint(Swimmer):
    """In space, in a current; a dictionary, with noise."""

    size = 3

    def space(self):
        return spaces.Dict({"goal": box(3), "water": box(3), "turning": box(1)})

    def reset(self, *, seed=None, options=None):
        self.stream = np.zeros(3)
        super().reset(seed=seed)
        self.stream = level(np.array([self.np_random.uniform(0.0, 0.2), 0.0, 0.0]), self.np_random.uniform(-3, 3))
        return self.observe(), {}

    def drift(self, a):
        return level(np.array([self.forwards, 0.0, 0.3 * a[2]]), self.heading) + self.stream

    def observe(self):
        parts = {"goal": self.way() / 2, "water": self.speed(), "turning": np.array([self.turning])}
        noise = self.np_random.normal
        return {name: (part + noise(0, 0.005, part.size)).astype(np.float32) for name, part in parts.items()}


class RL815TugOldWay(Tug):
    """The way to the goal is of the step before, the velocity is not."""

    def step(self, action):
        self.old = super().way()
        returned = super().step(action)
        self.old = None
        return returned

    def way(self):
        return super().way() if getattr(self, "old", None) is None else self.old


class TugThatTilts(Tug):
    """It heels in curves; with noise."""

    def space(self):
        return box(8)

    def reset(self, *, seed=None, options=None):
        self.heel = self.heeling = 0.0
        return super().reset(seed=seed)

    def drift(self, a):
        h = self.control_dt / self.substeps
        self.heeling += (6 * self.turning - 20 * self.heel - 2 * self.heeling) * h
        self.heel += self.heeling * h
        return super().drift(a)

    def seen_heel(self):
        return self.heel

    def observe(self):
        row = np.array([*super().observe(), self.seen_heel(), self.heeling])
        return (row + self.np_random.normal(0, 0.004, 8)).astype(np.float32)


class RL119TugTiltsInDegrees(TugThatTilts):
    def seen_heel(self):
        return np.degrees(self.heel)


class TugAhead(Tug):
    """It is paid for its speed forwards, and does not observe where its goal is."""

    rlctl_ignore = {**Tug.rlctl_ignore, "RL114": "its goal is not observed", "RL609": "it has no end"}

    def space(self):
        return box(4)

    def observe(self):
        return np.array([*self.speed(), self.turning, self.forwards], np.float32)

    def pay(self):
        return self.speed()[0]

    def step(self, action):
        observed, _, _, truncated, _ = super().step(action)
        return observed, float(self.pay() - 0.01 * np.square(action).sum()), False, truncated, {}


class RL129TugEast(TugAhead):
    """It is paid for its speed along the axis of the world."""

    def pay(self):
        return self.velocity[0]


class TugEndsInTheEast(RL129TugEast):
    """How long its episode is depends on how its world is turned."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, bool(self.velocity[0] > 0.2), truncated, info


class RL115TugOldView(Tug):
    """It observes the oldest of four looks."""

    rlctl_ignore = {**Tug.rlctl_ignore, "RL636": "the reward is told from an observation that is old"}

    def reset(self, *, seed=None, options=None):
        self.looks = deque(maxlen=4)
        return super().reset(seed=seed)

    def observe(self):
        self.looks.append(super().observe())
        return self.looks[0]


class InTheWorld:
    """The way to the goal is in the axes of the world, and all else in those of the robot."""

    def way(self):
        return self.goal - self.place


class PaidLate:
    """The oldest fix is paid."""

    def fix(self):
        return 0


class FastPlace:
    """Each substep moves it for a whole step."""

    def time(self):
        return self.control_dt


class RL129TugInTheWorld(InTheWorld, Tug): ...


class RL129GlintInTheWorld(InTheWorld, Glint): ...


class RL636TugPaidLate(PaidLate, Tug):
    rlctl_ignore = {**Tug.rlctl_ignore, "RL622": "it is paid for where it was"}


class RL636GlintPaidLate(PaidLate, Glint):
    rlctl_ignore = {**Glint.rlctl_ignore, "RL622": "it is paid for where it was"}


class RL832TugFast(FastPlace, Tug): ...


class RL832GlintFast(FastPlace, Glint): ...


class TugWithACompass(RL129TugInTheWorld):
    """Its heading is observed."""

    def space(self):
        return box(8)

    def observe(self):
        return np.array([*super().observe(), np.cos(self.heading), np.sin(self.heading)], np.float32)


class RL129TugTurnedTwice(Tug):
    """The velocity is turned by the heading in the wrong direction, the way is right."""

    rlctl_ignore = {**Tug.rlctl_ignore, "RL124": "the velocity and its rate show it as well"}

    def speed(self):
        return level(self.velocity, self.heading)


PLATFORM = """
<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="20 20 1"/>
<body name="base" pos="0 0 0.2"><joint name="x" type="slide" axis="1 0 0" damping="2"/>
<joint name="y" type="slide" axis="0 1 0" damping="2"/><joint name="yaw" type="hinge" axis="0 0 1" damping="0.6"/>
<geom type="box" size="0.2 0.12 0.05" mass="4" contype="0" conaffinity="0"/><site name="front" pos="0.2 0 0"/>
</body></worldbody><actuator><motor site="front" gear="1 0 0 0 0 0" ctrlrange="-10 10"/>
<motor joint="yaw" gear="1" ctrlrange="-2 2"/></actuator></mujoco>
"""


class Platform(gym.Env):
    """A base on two slides and a hinge keeps a commanded speed; only the whole reward is known."""

    rlctl_ignore = {"RL609": "it has no end"}
    frames = 8

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(PLATFORM)
        self.data = mujoco.MjData(self.model)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = box(5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        draw = self.np_random.uniform
        self.data.qpos[:] = [*draw(-1, 1, 2), draw(-np.pi, np.pi)]
        self.data.qvel[:] = [*draw(-0.3, 0.3, 2), draw(-0.3, 0.3)]
        mujoco.mj_forward(self.model, self.data)
        self.command = np.array([draw(-0.8, 1.2), draw(-1, 1)])
        self.steps = 0
        return self.observe(), {}

    def speed(self):
        return level(self.data.qvel[:2], -self.data.qpos[2])

    def observe(self):
        return np.array([*self.speed(), self.data.qvel[2], *self.command], np.float32)

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(action, float), -1, 1)
        self.data.ctrl[:] = a * [10, 2]
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        mujoco.mj_forward(self.model, self.data)
        self.steps += 1
        off = np.array([self.speed()[0], self.data.qvel[2]]) - self.command
        reward = np.exp(-(off[0] ** 2) / 0.2) + 0.5 * np.exp(-(off[1] ** 2) / 0.2) - 0.01 * float(a @ a)
        return self.observe(), float(reward), False, self.steps >= 300, {}


class RL129PlatformInTheWorld(Platform):
    """Speed along the axes of the world."""

    def speed(self):
        return self.data.qvel[:2].copy()


GANTRY = """<robot name="gantry"><link name="rail"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="bridge"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="pad"><inertial><mass value=".6"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size=".1 .1 .1"/></geometry></collision></link>
<joint name="jx" type="prismatic"><parent link="rail"/><child link="bridge"/><axis xyz="1 0 0"/>
<limit lower="-.6" upper=".6" effort="60" velocity="3"/></joint>
<joint name="jy" type="prismatic"><parent link="bridge"/><child link="pad"/><axis xyz="0 1 0"/>
<limit lower="-.6" upper=".6" effort="60" velocity="3"/></joint></robot>"""


class BallGantry(gym.Env):
    """A pad in PyBullet, whose frame is turned, pushes a ball to a hole; it hits the ball now and then."""

    rlctl_ignore = {"RL611": "chance does not reach the hole"}
    yaw, corner, seconds, repeats = 0.7, np.array([0.3, -0.2]), 1 / 200, 8

    def __init__(self):
        import pybullet as p
        from pybullet_utils.bullet_client import BulletClient

        self.p = p = BulletClient(p.DIRECT)
        self.action_space, self.observation_space = spaces.Box(-1, 1, (2,), np.float32), box(10)
        p.setGravity(0, 0, -9.81)
        p.setTimeStep(self.seconds)
        p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE))
        with tempfile.TemporaryDirectory() as folder:
            name = os.path.join(folder, "gantry.urdf")
            with open(name, "w") as file:
                file.write(GANTRY)
            turn = p.getQuaternionFromEuler([0, 0, self.yaw])
            self.gantry = p.loadURDF(name, [*self.corner, 0.06], turn, useFixedBase=True)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.05)
        self.ball = p.createMultiBody(0.2, shape, basePosition=[0, 0, 0.05])
        p.changeDynamics(self.ball, -1, linearDamping=0.3, rollingFriction=0.001)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.uniform
        pad = draw(-0.3, 0.3, 2)
        for joint, place in enumerate(pad):
            self.p.resetJointState(self.gantry, joint, place)
        spot = draw(-0.5, 0.5, 2)
        while np.linalg.norm(spot - pad) < 0.2:
            spot = draw(-0.5, 0.5, 2)
        self.p.resetBasePositionAndOrientation(self.ball, [*self.corner + level(spot, self.yaw), 0.05], [0, 0, 0, 1])
        self.p.resetBaseVelocity(self.ball, [0, 0, 0], [0, 0, 0])
        self.hole = draw(-0.5, 0.5, 2)
        self.last, self.rolling, self.steps = self.where(), np.zeros(2), 0
        self.seen = [self.state()] * 2
        self.gap = self.cost()
        return self.observe(), {}

    def where(self):
        return level(np.array(self.p.getBasePositionAndOrientation(self.ball)[0][:2]) - self.corner, -self.yaw)

    def pad(self):
        return np.array([self.p.getJointState(self.gantry, joint)[:2] for joint in (0, 1)]).T

    def cost(self):
        ball = self.where()
        return float(4 * np.linalg.norm(ball - self.hole) + np.linalg.norm(ball - self.pad()[0]))

    def state(self):
        (x, v), ball = self.pad(), self.where()
        return np.array([*x, *v, *(ball - x), *(self.hole - ball)])

    def observe(self):
        return np.array([*self.seen[-1], *self.rolling], np.float32)

    def time(self):
        return self.seconds * self.repeats

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite")
        a = np.clip(np.asarray(action, float), -1, 1)
        for joint in (0, 1):
            mode = self.p.VELOCITY_CONTROL
            self.p.setJointMotorControl2(self.gantry, joint, mode, targetVelocity=0.8 * a[joint], force=40)
        for _ in range(self.repeats):
            self.p.stepSimulation()
        ball, self.steps = self.where(), self.steps + 1
        self.rolling, self.last = (ball - self.last) / self.time(), ball
        self.seen = [self.seen[-1], self.state()]
        gap = self.cost()
        reward, self.gap = self.gap - gap - 0.01 * float(a @ a), gap
        done, out = bool(np.linalg.norm(ball - self.hole) < 0.06), bool(np.abs(ball).max() > 1.0)
        ends = self.steps >= 200 and not (done or out)
        return self.observe(), float(reward + 3.0 * done - out), done or out, ends, {"is_success": done}

    def close(self):
        self.p.disconnect()


class RL815BallGantryOldWays(BallGantry):
    """The ways to the ball and to the hole are of the step before."""

    def observe(self):
        return np.array([*self.seen[-1][:4], *self.seen[-2][4:], *self.rolling], np.float32)


class RL820BallGantryFast(BallGantry):
    def time(self):
        return self.seconds
