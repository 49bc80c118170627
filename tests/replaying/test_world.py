"""What a look at a world reports: bodies, joints, masses, contacts, falls; of a task, of PyBullet, of MuJoCo."""

import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rlctl.engine import MUJOCO
from rlctl.environments.bullet_clients import find_clients
from rlctl.environments.spec import EnvSpec
from rlctl.replaying.look import BodySummary, Contact, JointSummary, Motion, Pose, Touch, WorldSummary, WorldWatch
from rlctl.replaying.look_readers import make_world_reader
from rlctl.replaying.look_table import list_findings
from rlctl.replaying.recorder import play_episode
from tests.replaying.conftest import ENVS

BULLET_ENVS = Path(__file__).with_name("bullet_envs.py")

LEVEL = (0.0, 0.0, 0.0, 1.0)


class Script:
    """A reader of poses and touches that a test gives, one per step."""

    def __init__(self, heights, turns=None, touches=None):
        self.heights, self.turns, self.touches = (
            iter(heights),
            iter(turns or [LEVEL] * 100),
            iter(touches or [()] * 100),
        )

    def read_bodies(self):
        return []

    def read_poses(self):
        return {"box": Pose((0.0, 0.0, next(self.heights)), next(self.turns))}

    def read_touches(self):
        return next(self.touches)


def watch(steps, *arguments, **keywords) -> WorldSummary:
    world = WorldWatch(Script(*arguments, **keywords), seed=0, dt=0.1)
    for step in range(steps + 1):
        world.read(step)
    return world.summarize()


def look(task, **parameters) -> WorldSummary:
    """Play an episode with zero actions."""
    others, spec = find_clients(), EnvSpec(task, parameters)
    with closing(spec.make()) as env:
        worlds = []

        def read(step):
            if step == 0:
                worlds.append(WorldWatch(make_world_reader(env, others), 0, 0.1))
            worlds[0].read(step)

        zero = np.zeros(env.action_space.shape, env.action_space.dtype)
        play_episode(env, spec, 3, lambda observation, step: zero if step < 60 else None, watch=read)
        return worlds[0].summarize()


def motion(world, body) -> Motion:
    return next(motion for motion in world.motions if motion.body == body)


def test_a_drop_is_a_fifth_of_the_height():
    (box,) = watch(3, [1.0, 0.9, 0.79, 0.85]).motions  # 0.79 is the first below 0.8
    assert (box.start, box.lowest, box.highest, box.end, box.dropped_at) == (1.0, 0.79, 1.0, 0.85, 2)
    (box,) = watch(1, [0.02, 0.011]).motions  # a fifth is 4 mm, but less than 1 cm
    assert box.dropped_at is None


def test_tilt_is_of_the_vertical_axis():
    half = math.radians(60) / 2
    about_z, about_x = (0.0, 0.0, math.sin(half), math.cos(half)), (math.sin(half), 0.0, 0.0, math.cos(half))
    (box,) = watch(2, [1.0] * 3, [LEVEL, about_z, about_x]).motions
    assert box.tilt == pytest.approx(60)
    assert box.tipped_at == 2
    (box,) = watch(1, [1.0] * 2, [about_x, about_x]).motions  # it lies so from the beginning
    assert box.tilt == pytest.approx(0, abs=1e-5)


def test_a_simulation_that_diverges():
    (box,) = watch(2, [1.0, 1.5, math.nan]).motions
    assert (box.lost_at, box.highest, box.end) == (2, 1.5, 1.5)


def test_contacts_have_the_step_in_which_they_began():
    touches = [
        [Touch("box", "foot", "ground", 0.002)],
        [Touch("box", "foot", "ground", 0.5)],
        [Touch("box", "hip", "box", 0)],
    ]
    assert watch(3, [1.0] * 4, None, touches).contacts == [
        Contact("box", "foot", "ground", 1, 0.002),
        Contact("box", "hip", "box", 3, 0),
    ]


@pytest.mark.pybullet
def test_a_task():
    world = look(f"{ENVS}:Tumble")
    ground, cube, car = world.bodies
    assert (ground.name, ground.mass, ground.base, ground.joints) == ("ground", 0.0, "fixed", [])
    assert (cube.name, cube.mass, cube.base, cube.links) == ("cube", pytest.approx(0.1), "free", 1)
    assert len(car.joints) == 6  # four wheels, and two that steer
    # It falls from 0.4 m to the ground, and is 5 cm high. Its frame is turned by 74 degrees about z only.
    cube = motion(world, "cube")
    assert cube.start == pytest.approx(0.4)
    assert cube.end == pytest.approx(0.025, abs=2e-3)
    assert cube.dropped_at is not None
    assert cube.tilt < 45
    assert {(contact.body, contact.other) for contact in world.contacts} == {("cube", "ground"), ("car", "ground")}


@pytest.mark.pybullet
def test_joints_of_a_task():
    arm = look("reach").bodies[1]
    joint = arm.joints[1]
    assert (joint.name, joint.unit, joint.max_force, joint.max_speed) == ("lbr_iiwa_joint_2", "rad", 300.0, 10.0)
    assert (joint.low, joint.high) == (pytest.approx(-2.0944, abs=1e-4), pytest.approx(2.0944, abs=1e-4))
    gripper = look("gear-arm").bodies[0].joints
    assert {joint.unit for joint in gripper} == {"rad", "m"}


@pytest.mark.pybullet
def test_a_plain_environment_of_pybullet(write_module):
    file = write_module(
        "plain.py",
        """
        import gymnasium, numpy as np, pybullet as p
        from gymnasium import spaces

        class Falling(gymnasium.Env):
            action_space = observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

            def __init__(self, removed_at=0):
                self.removed_at = removed_at

            def reset(self, *, seed=None, options=None):
                self.c = c = p.connect(p.DIRECT)
                p.setGravity(0, 0, -10, physicsClientId=c)
                p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=c), physicsClientId=c)
                ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.1, physicsClientId=c)
                p.createMultiBody(
                    2.0, ball, basePosition=[0, 0, 0.3], linkMasses=[0.5], linkCollisionShapeIndices=[-1],
                    linkVisualShapeIndices=[-1], linkPositions=[[0, 0, 0]], linkOrientations=[[0, 0, 0, 1]],
                    linkInertialFramePositions=[[0, 0, 0]], linkInertialFrameOrientations=[[0, 0, 0, 1]],
                    linkParentIndices=[0], linkJointTypes=[p.JOINT_PRISMATIC], linkJointAxis=[[1, 0, 0]],
                    physicsClientId=c,
                )
                self.steps = 0
                return np.zeros(1, np.float32), {}

            def step(self, action):
                self.steps += 1
                p.stepSimulation(physicsClientId=self.c)
                if self.steps == self.removed_at:
                    p.removeBody(1, physicsClientId=self.c)
                return np.zeros(1, np.float32), 0.0, False, False, {}

            def close(self):
                p.disconnect(self.c)
        """,
    )
    world = look(f"{file}:Falling")
    ball = next(body for body in world.bodies if body.joints)
    assert (ball.mass, ball.base, ball.links) == (2.5, "free", 2)
    assert (ball.joints[0].unit, ball.joints[0].low, ball.joints[0].max_force) == ("m", None, None)
    # Falls 0.2 m in 0.2 s, which are 48 steps of 1/240 s.
    assert motion(world, ball.name).lowest == pytest.approx(0.1, abs=0.01)
    (contact,) = world.contacts
    assert contact.body == ball.name
    assert 45 <= contact.step <= 52
    removed = look(f"{file}:Falling", removed_at=20)
    assert motion(removed, ball.name).lowest > 0.2


@pytest.mark.pybullet
def test_a_robot_on_rails_in_pybullet():
    world = look(f"{BULLET_ENVS}:Crawler", file="mjcf/half_cheetah.xml")
    robot = next(body for body in world.bodies if body.joints)
    assert (robot.base, robot.joints[0].unit, robot.joints[0].low) == ("rail", "m", None)
    assert motion(world, robot.name).lowest > 0  # of the torso, not of the frame that the rails begin at


def test_mujoco():
    pytest.importorskip("mujoco")
    world = look("Ant-v5")
    ground, ant = world.bodies
    assert (ground.name, ground.base) == ("world", "fixed")
    assert (ant.name, ant.base, ant.links, len(ant.joints)) == ("torso", "free", 13, 8)
    ankle = ant.joints[1]
    assert (ankle.name, ankle.low, ankle.high) == (
        "ankle_1",
        pytest.approx(0.5236, abs=1e-4),
        pytest.approx(1.2217, abs=1e-4),
    )
    assert ankle.is_outside  # Gymnasium places it at 0
    assert motion(world, "torso").dropped_at is not None
    cheetah = look("HalfCheetah-v5").bodies[1]
    assert (cheetah.base, cheetah.joints[0].unit, cheetah.joints[0].low) == ("rail", "m", None)


def test_a_task_in_mujoco():
    pytest.importorskip("mujoco")
    spec = EnvSpec("quadruped", sim=MUJOCO)
    with closing(spec.make()) as env:
        env.reset(seed=0)
        ground, robot = make_world_reader(env).read_bodies()
    assert (ground.name, ground.base) == ("ground", "fixed")
    assert (robot.name, robot.base, len(robot.joints)) == ("robot", "free", 12)
    assert robot.mass == pytest.approx(12.46, abs=0.01)
    hip = robot.joints[0]
    # As code names it, with the limits of the URDF.
    assert (hip.name, hip.max_force, hip.max_speed) == ("FR_hip_joint", 20.0, hip.max_speed)


def test_nothing_to_read():
    with closing(EnvSpec("CartPole-v1").make()) as env:
        env.reset(seed=0)
        assert make_world_reader(env, find_clients()) is None


JOINTS = [JointSummary("hip", "rad", -1.0, 1.0, 1.2, 20.0, 3.0), JointSummary("slide", "m", None, None, 0.0)]
WORLD = WorldSummary(
    seed=0,
    bodies=[BodySummary("robot", 12.5, 3, "free", JOINTS), BodySummary("ground", 0.0, 1, "fixed", [])],
    contacts=[Contact("robot", "foot", "ground", 1, 0.0042), Contact("robot", "hip", "robot", 7, 0.0)],
    motions=[Motion("robot", 0.28, 0.1, 0.28, 0.12, 92.4, 31, 28, None)],
    dt=0.02,
)


def test_what_is_striking():
    assert list(list_findings(WORLD)) == [
        "robot: joint hip begins at 1.200 rad, outside its limits -1.000 to 1.000",
        "robot drops from 0.280 to 0.100 m (a fifth by step 31, 0.62 s) and tips by 92 degrees (45 by step 28, 0.56 s)",
    ]
    lost = Motion("robot", 0.3, 0.3, 0.3, 0.3, 0.0, None, None, 5)
    assert [*list_findings(WorldSummary(0, [], [], [lost], None))][-1] == (
        "robot: its position is not finite after step 5: the simulation has diverged"
    )
    assert list(list_findings(WorldSummary(0, [], [], [], None))) == ["nothing touches"]


def test_as_json():
    assert WORLD.as_json()["bodies"][0]["joints"][0]["max_force"] == 20.0
    assert WORLD.as_json()["motions"][0]["dropped_at"] == 31
