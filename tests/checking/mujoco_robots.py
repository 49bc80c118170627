"""Robots in MuJoCo without a mistake, from which `broken_mujoco.py` derives robots with one mistake each."""

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from scipy.spatial.transform import Rotation

ARM = """
<mujoco><compiler angle="degree"/><option timestep="0.004" integrator="implicitfast"/>
<default><joint damping="1" armature=".02"/></default>
<worldbody><geom name="table" type="plane" size="1 1 .1"/>
<body name="upper" pos="0 0 .3"><joint name="shoulder" axis="0 1 .3" range="-60 150"/>
  <geom name="upper_arm" type="capsule" fromto="0 0 0 0 0 .3" size=".03" mass="1"/>
  <body name="lower" pos="0 0 .3"><joint name="elbow" axis="0 1 0" range="-20 140"/>
    <geom name="lower_arm" type="capsule" fromto="0 0 0 0 0 .25" size=".025" mass=".6"/>
    <body name="hand" pos="0 0 .25"><joint name="wrist" axis="1 0 0" range="-170 170"/>
      <geom name="palm" type="box" size=".03 .03 .02" mass=".2"/>
      <geom name="finger" type="sphere" pos="0 0 .08" size=".02" mass=".05"/>
      <site name="tip" pos="0 0 .1"/></body></body></body></worldbody>
<actuator><position name="turn" joint="wrist" kp="40" ctrlrange="-2.96 2.96"/>
<position name="lift" joint="shoulder" kp="200" forcerange="-60 60" ctrlrange="-1.04 2.61"/>
<position name="bend" joint="elbow" kp="120" forcerange="-40 40" ctrlrange="-.34 2.44"/></actuator>
<sensor><framepos objtype="site" objname="tip"/><framelinvel objtype="site" objname="tip"/></sensor></mujoco>
"""
LEG = """
<body name="{n}_thigh" pos="{x} {y} -.05"><joint name="{n}_hip" axis="0 1 0" range="-90 90"/>
  <geom name="{n}_thigh" type="capsule" fromto="0 0 0 0 0 -.2" size=".03" mass=".5"/>
  <body name="{n}_shin" pos="0 0 -.2"><joint name="{n}_knee" axis="0 1 0" range="-150 30"/>
    <geom name="{n}_shin" type="capsule" fromto="0 0 0 0 0 -.18" size=".02" mass=".3"/>
    <body name="{n}_foot" pos="0 0 -.2">
      <geom name="{n}_sole" type="box" size=".05 .03 .015" mass=".1"/></body></body></body>
"""
MOTOR = '<motor name="{n}" joint="{n}" ctrllimited="true" ctrlrange="-12 12"/>'
SIDES = ("left", "right", "back")
HOPPER = f"""
<mujoco><option timestep="0.002"/><default><joint damping=".3" armature=".01"/></default>
<worldbody><geom name="ground" type="plane" size="9 9 1"/>
<body name="body" pos="0 0 .5"><freejoint/><geom name="box" type="box" size=".15 .12 .05" mass="3"/>
{"".join(LEG.format(n=n, x=x, y=y) for n, x, y in zip(SIDES, (0.1, 0.1, -0.12), (0.12, -0.12, 0.0), strict=True))}
</body></worldbody><actuator>
{"".join(MOTOR.format(n=f"{side}_{joint}") for side in SIDES for joint in ("hip", "knee"))}
</actuator></mujoco>
"""


class MujocoRobot(gymnasium.Env):
    """What both share: actions in [-1, 1], a time limit, and the order of a step."""

    xml, joints, frames, limit = "", 3, 5, 60

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(self.xml)
        self.data = mujoco.MjData(self.model)
        self.forward()
        self.action_space = spaces.Box(-1.0, 1.0, (self.joints,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.size(),), np.float32)

    def size(self):
        return len(self.observe())

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.clear()
        self.start()
        self.forward()
        self.steps = 0
        return self.observe().astype(np.float32), {}

    def clear(self):
        mujoco.mj_resetData(self.model, self.data)

    def forward(self):
        mujoco.mj_forward(self.model, self.data)

    def step(self, action):
        if not np.isfinite(action).all():
            raise ValueError(f"action {action} is not finite")
        self.steps += 1
        self.move(np.clip(action, -1.0, 1.0).astype(float))
        reward = float(self.reward() - 0.01 * np.square(action).sum())
        return (
            self.observe().astype(np.float32),
            reward,
            False,
            self.steps >= self.limit,
            {"is_success": self.succeeds()},
        )


class MujocoArm(MujocoRobot):
    """An arm with position actuators, in another order than its joints, brings its tip to a goal."""

    xml = ARM
    home = np.array([0.4, 1.2, -0.8])  # of shoulder, elbow and wrist [rad]
    goal = np.zeros(3)
    gain = 0.6

    def __init__(self):
        super().__init__()
        self.motors = [self.model.actuator(name).id for name in ("lift", "bend", "turn")]

    def start(self):
        self.data.qpos[:] = self.home + self.np_random.uniform(-0.05, 0.05, 3)
        self.goal = self.np_random.uniform([0.2, -0.2, 0.2], [0.5, 0.2, 0.6])

    def targets(self, action):
        return self.home + self.gain * action

    def move(self, action):
        self.data.ctrl[self.motors] = self.targets(action)
        mujoco.mj_step(self.model, self.data, nstep=self.frames)
        self.forward()

    def tip(self):
        return self.data.site("tip").xpos

    def observe(self):
        return np.concatenate([self.data.qpos, self.data.qvel, self.goal - self.tip()])

    def distance(self):
        return float(np.linalg.norm(self.goal - self.tip()))

    def reward(self):
        return -self.distance()

    def succeeds(self):
        return self.distance() < 0.05


class MujocoHopper(MujocoRobot):
    """A box on three legs, whose motors get torques that follow targets."""

    xml, joints = HOPPER, 6
    home = np.array([0.5, -1.0, 0.3, -0.7, -0.6, 0.2])  # [rad]
    gains = 30.0, 0.6
    soles = tuple(f"{side}_sole" for side in SIDES)

    def __init__(self):
        super().__init__()
        self.ground = self.model.geom("ground").id

    def start(self):
        self.data.qpos[2] = 0.49
        turn = Rotation.from_euler("xyz", self.np_random.uniform([-0.1, -0.1, -3.0], [0.1, 0.1, 3.0]))
        self.data.qpos[3:7] = turn.as_quat(scalar_first=True)
        self.data.qpos[7:] = self.home + self.np_random.uniform(-0.1, 0.1, 6)

    def positions(self):
        return self.data.qpos[7:]

    def torques(self, action):
        stiffness, damping = self.gains
        return stiffness * (self.home + 0.4 * action - self.positions()) - damping * self.data.qvel[6:]

    def move(self, action):
        for _ in range(self.frames):
            self.data.ctrl[:] = np.clip(self.torques(action), -12.0, 12.0)
            mujoco.mj_step(self.model, self.data)
        self.forward()

    def attitude(self):
        return Rotation.from_quat(self.data.qpos[3:7], scalar_first=True)

    def touches(self):
        touching = set()
        for contact in self.data.contact:
            if self.ground in contact.geom:
                touching |= set(contact.geom.tolist())
        return np.array(
            [mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, name) in touching for name in self.soles]
        )

    def observe(self):
        forward = self.attitude().inv().apply(self.data.qvel[:3])
        parts = [self.attitude().as_euler("xyz")[:2], forward, self.data.qvel[3:], self.data.qpos[7:], self.touches()]
        return np.concatenate([self.data.qpos[2:3], *parts])

    def reward(self):
        return self.ahead() - 0.1 * abs(self.data.qpos[2] - 0.45)

    def succeeds(self):
        return self.ahead() > 0.3

    def ahead(self):
        """How fast it moves in the direction in which it looks [m/s]."""
        turn = Rotation.from_quat(self.data.qpos[3:7], scalar_first=True)
        return float(turn.inv().apply(self.data.qvel[:3])[0])
