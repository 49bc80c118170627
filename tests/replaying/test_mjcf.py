"""MJCF robots are drawn where PyBullet simulates them, and the camera goes along."""

import dataclasses
import functools
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rlctl.environments.spec import EnvSpec
from rlctl.replaying.bodies import shape_centers
from rlctl.replaying.bullet_scene import TaskReader
from rlctl.replaying.drawable import make_drawable
from rlctl.replaying.mjcf import Shape, ShapeKind, read_shapes
from rlctl.replaying.recorder import play_episode
from rlctl.replaying.rrd import write_rrd
from rlctl.replaying.scene import BodyMotion
from rlctl.task.pybullet.library import pybullet
from tests.replaying.conftest import play
from tests.replaying.reading import column, entities, layout, static

pytestmark = pytest.mark.pybullet

ROBOTS = ("ant", "half-cheetah", "hopper", "walker2d", "humanoid")
PROBE_RADIUS = 0.01  # [m]
MARGIN = 0.04  # [m]; Bullet rounds off what is thinner


def turn(quaternion, vector):
    """Turn a vector by a quaternion (x, y, z, w), as PyBullet does."""
    return np.array(pybullet.multiplyTransforms((0, 0, 0), quaternion, list(vector), (0, 0, 0, 1))[0])


def ends(shape: Shape, position, orientation):
    """Return the ends of a capsule's axis in the world [m], or twice the middle of a sphere, and the radius [m]."""
    half, radius = (shape.size[0] / 2, shape.size[1]) if shape.kind == ShapeKind.CAPSULE else (0, shape.size[0])
    middle = position + turn(orientation, shape.position)
    along = half * turn(orientation, turn(shape.orientation, (0, 0, 1)))
    return middle - along, middle + along, radius


def distance(point, low, high, radius):
    """Return how far a point is from a capsule [m]."""
    axis = high - low
    part = np.clip((point - low) @ axis / max(axis @ axis, 1e-12), 0, 1)
    return np.linalg.norm(point - low - part * axis) - radius


def look(env) -> BodyMotion:
    reader = TaskReader(env.unwrapped)
    reader.read(0)
    return next(body for body in reader.scene().bodies if body.name == "robot")


def worst_error(env) -> float:
    """Return by how much our distances from points around each link are wrong [m], as PyBullet measures them."""
    sim, robot = env.unwrapped.sim, look(env)
    sphere = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=PROBE_RADIUS, physicsClientId=sim.client)
    probe = pybullet.createMultiBody(0, sphere, physicsClientId=sim.client)
    worst = 0.0
    for index, link in enumerate(robot.links):
        position, orientation = robot.positions[0, index], robot.orientations[0, index]
        capsules = [ends(shape, position, orientation) for shape in robot.shapes if shape.link == link]
        if not capsules or min(radius for *_, radius in capsules) < MARGIN:
            continue
        for low, high, _ in capsules:
            axis = (high - low) / max(np.linalg.norm(high - low), 1e-9)
            # Beyond both ends, and beside both: what is a millimetre off is seen from one of them.
            beside = np.cross(axis, (0.36, 0.48, 0.8)) if axis.any() else np.array((0.36, 0.48, 0.8))
            for point in (low - 0.5 * axis, high + 0.5 * axis, low + 0.5 * beside, high - 0.5 * beside):
                pybullet.resetBasePositionAndOrientation(
                    probe, point.tolist(), (0, 0, 0, 1), physicsClientId=sim.client
                )
                found = pybullet.getClosestPoints(
                    sim.body("robot").id, probe, 5.0, linkIndexA=index - 1, linkIndexB=-1, physicsClientId=sim.client
                )
                theirs = min(each[8] for each in found) + PROBE_RADIUS
                ours = min(distance(point, *capsule) for capsule in capsules)
                worst = max(worst, abs(ours - theirs))
    pybullet.removeBody(probe, physicsClientId=sim.client)
    return worst


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize("name", ROBOTS)
def test_capsules_are_where_pybullet_has_them(name):
    env = EnvSpec(name).make()
    try:
        env.action_space.seed(0)
        env.reset(seed=1)
        assert worst_error(env) < 1e-3
        for _ in range(50):  # not by env.step: most robots are down before, and the episode over
            env.unwrapped.task.act(env.action_space.sample())
            env.unwrapped.sim.step()
        assert worst_error(env) < 1e-3
    finally:
        env.close()


def test_thin_capsules_are_where_pybullet_has_them():
    # Distances to the humanoid's lower arms, of radius 0.031, are rounded off; their boxes are not. A capsule that is
    # given by its ends has a box with twice the margin, which is once 0.04 m more than it needs.
    env = EnvSpec("humanoid").make()
    try:
        env.reset(seed=1)
        sim = env.unwrapped.sim
        sim.body("robot").set_joints(np.zeros(17))  # a turned box would be wider than what it holds
        robot = look(env)
        for link in ("left_lower_arm", "right_lower_arm"):
            index = robot.links.index(link)
            boxes = []
            for shape in (shape for shape in robot.shapes if shape.link == link):
                low, high, radius = ends(shape, robot.positions[0, index], robot.orientations[0, index])
                radius += MARGIN if shape.kind == ShapeKind.CAPSULE else 0.0
                boxes.append((np.minimum(low, high) - radius, np.maximum(low, high) + radius))
            lowest, highest = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
            theirs = pybullet.getAABB(sim.body("robot").id, index - 1, physicsClientId=sim.client)
            np.testing.assert_allclose(theirs, (lowest, highest), atol=1e-3)
    finally:
        env.close()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The recording of a robot and its rollout, made when it is first asked for."""
    folder = tmp_path_factory.mktemp("mjcf")

    @functools.cache
    def record(name):
        spec, warnings = EnvSpec(name, {}), []
        with closing(make_drawable(spec)) as env:
            env.action_space.seed(0)
            actions = iter([env.action_space.sample() for _ in range(1000)])
            rollout = play_episode(env, spec, 3, lambda o, k, a=actions: next(a), policy="chance", draw=warnings.append)
        path = folder / f"{name}.rrd"
        write_rrd(path, rollout, title=name, warn=warnings.append)
        assert warnings == []
        return path, rollout

    return record


# ant.xml: a belly, and three capsules for each of four legs. humanoid_symmetric.xml: torso 3, waist, pelvis, thigh,
# shin and foot twice, arms of 1 and 2 geoms twice. hopper.xml: torso, thigh, leg, foot.
@pytest.mark.slow_except("ant-13")
@pytest.mark.parametrize(
    ("name", "count"), [("ant", 1 + 4 * 3), ("humanoid", 3 + 1 + 1 + 2 * 3 + 2 * 3), ("hopper", 4)]
)
def test_every_geom_is_drawn_and_its_link_moves(recording, name, count):
    path, rollout = recording(name)
    found = entities(path)
    assert len([entity for entity in found if entity.startswith("/world/robot/") and "/shape_" in entity]) == count
    robot = rollout.scene.robots()[0]
    for link in {shape.link for shape in robot.shapes}:
        _, positions = column(path, f"/world/robot/{link}", "Transform3D:translation")
        np.testing.assert_allclose(positions[:, 0], robot.positions[:, robot.links.index(link)], atol=1e-5)


def test_a_capsule_has_its_size_and_colour(recording):
    path, _ = recording("ant")
    # <geom fromto="0 0 0 0.4 0.4 0" size="0.08" rgba=".8 .5 .3 1"/>: 0.4 * sqrt(2) long, around (0.2, 0.2, 0).
    foot = "/world/robot/front_left_foot/shape_0"
    assert static(path, foot, "Capsules3D:lengths") == pytest.approx([0.4 * 2**0.5])
    assert static(path, foot, "Capsules3D:radii") == pytest.approx([0.08])
    assert static(path, foot, "Transform3D:translation")[0] == pytest.approx([0.2, 0.2, 0.0])
    # RGBA in one number: 0.8, 0.5, 0.3 and 1 of 255. The other legs have the default's 0.8, 0.6, 0.4.
    assert static(path, foot, "Capsules3D:colors") == [204 << 24 | 128 << 16 | 76 << 8 | 255]
    other = "/world/robot/front_right_foot/shape_0"
    assert static(path, other, "Capsules3D:colors")[0] >> 8 & 0xFF == 102


@pytest.mark.slow
def test_path_goes_through_the_torso_and_not_through_a_frame_outside_of_it(recording):
    # hopper.xml puts all frames at the origin; the torso reaches from 1.05 to 1.45 m.
    path, _ = recording("hopper")
    _, strips = column(path, "/world/paths/robot", "LineStrips3D:strips")
    assert strips[0, 0, 0] == pytest.approx([0.0, 0.0, 1.25], abs=0.05)


@pytest.mark.slow_except("ant-torso")
@pytest.mark.parametrize(("name", "torso"), [("ant", "torso"), ("humanoid", "torso"), ("hopper", "torso")])
def test_camera_follows_the_torso(recording, name, torso):
    (followed,) = tracked(recording(name)[0])
    assert followed == f"/world/robot/{torso}/shape_0"
    assert followed in entities(recording(name)[0])


@pytest.mark.slow
def test_camera_follows_no_arm(reached, tmp_path):
    write_rrd(tmp_path / "reach.rrd", reached, title="reach", warn=print)
    assert tracked(tmp_path / "reach.rrd") == []


@pytest.mark.slow
def test_camera_follows_a_free_urdf_robot(tmp_path):
    rollout, warnings = play("Tumble", car="r2d2.urdf")
    write_rrd(tmp_path / "r2d2.rrd", rollout, title="r2d2", warn=warnings.append)
    assert tracked(tmp_path / "r2d2.rrd") == ["/world/car/base_link/shape_0"]
    assert "/world/car/base_link/shape_0" in entities(tmp_path / "r2d2.rrd")


@pytest.mark.slow
def test_the_goal_of_a_small_robot_is_in_view(tmp_path):
    rollout, _ = play("Tumble", car="r2d2.urdf")
    # As if the goal were 6 m to the left of the robot, which is some 1.5 m high.
    goal = rollout.scene.robots()[0].positions[:, 0] + (0.0, 6.0, 0.0)
    scene = dataclasses.replace(rollout.scene, markers={"goal": goal})
    write_rrd(tmp_path / "r2d2.rrd", dataclasses.replace(rollout, scene=scene), title="r2d2", warn=print)
    eye = np.array(layout(tmp_path / "r2d2.rrd", "EyeControls3D:position")[0])
    center = np.array(layout(tmp_path / "r2d2.rrd", "EyeControls3D:look_target")[0])
    to_center, to_goal = center - eye, goal[0] - eye
    cosine = to_center @ to_goal / np.linalg.norm(to_center) / np.linalg.norm(to_goal)
    assert np.degrees(np.arccos(cosine)) < 55 / 2  # [deg], half of the viewer's field of view
    # And no further away than it has to be.
    assert np.linalg.norm(to_center) < 3 * 6


@pytest.mark.parametrize("name", ["ant", "hopper"])
def test_file_that_only_pybullet_reads_costs_a_warning(tmp_path, monkeypatch, name):
    def refuse(file):
        raise ValueError(f"{file}: not well-formed")

    monkeypatch.setattr("rlctl.replaying.bullet_track.read_shapes", refuse)
    warnings = []
    with closing(make_drawable(EnvSpec(name))) as env:
        action = np.zeros(env.action_space.shape, np.float32)
        rollout = play_episode(env, EnvSpec(name), 3, lambda o, k: action, policy="none", draw=warnings.append)
    write_rrd(tmp_path / "r.rrd", rollout, title=name, warn=warnings.append)
    assert warnings == [f"{name}.xml: 0 of 0 shapes of 'robot' could be drawn"]
    assert tracked(tmp_path / "r.rrd") == []


def tracked(path: Path) -> list[str]:
    """Return what the cameras of a recording's layout follow."""
    return layout(path, "EyeControls3D:tracking_entity")


MODEL = """<mujoco model="m">
  <default>
    <geom rgba="1 0 0 1"/>
    <default class="blue"><geom rgba="0 0 1 1"/></default>
  </default>
  <worldbody>
    <body name="trunk" childclass="blue">
      <geom type="box" size=".1 .2 .3" pos="0 0 1" quat="2 0 0 0"/>
      <body name="arm"><geom class="main" type="cylinder" size=".1" fromto="0 0 0 0 0 -2"/></body>
    </body>
    <body name="ball"><geom size=".1"/><geom type="ellipsoid" size="1 2 3" rgba="0 1 0 1"/></body>
  </worldbody>
</mujoco>"""


def test_geoms_of_every_kind(tmp_path):
    (tmp_path / "m.xml").write_text(MODEL)
    box, cylinder, ball, other = read_shapes(tmp_path / "m.xml")
    assert (box.link, box.size, box.position, box.orientation) == ("trunk", (0.2, 0.4, 0.6), (0, 0, 1), (0, 0, 0, 1))
    assert box.color == (0, 0, 1, 1)
    # Straight down: half a turn, and its middle a metre below.
    assert (cylinder.size, cylinder.position, cylinder.color) == ((2, 0.1), (0, 0, -1), (1, 0, 0, 1))
    assert turn(cylinder.orientation, (0, 0, 1)) == pytest.approx([0, 0, -1])
    assert (ball.kind, ball.size) == (ShapeKind.SPHERE, (0.1,))
    assert (other.kind, other.mesh) == (ShapeKind.MESH, None)  # PyBullet knows no ellipsoids


def test_shapes_turn_with_their_link():
    robot = BodyMotion(
        name="m",
        file=Path("m.xml"),
        ground_height=None,
        terrain=None,
        joint_names=[],
        joint_positions=np.zeros((1, 0)),
        joint_velocities=np.zeros((1, 0)),
        links=["trunk"],
        positions=np.array([[[1.0, 2.0, 3.0]]]),
        orientations=np.array([[[0.0, 0.0, 0.5**0.5, 0.5**0.5]]]),  # a quarter turn about z
        shapes=[Shape("trunk", ShapeKind.SPHERE, (0.1,), None, (0.5, 0.0, 0.0), (0, 0, 0, 1), (1, 1, 1, 1))],
        trunk=0,
        box=(np.zeros(3), np.ones(3)),
    )
    assert shape_centers(robot, 0)[0, 0] == pytest.approx([1.0, 2.5, 3.0])  # x becomes y


def test_file_that_is_no_xml(tmp_path):
    (tmp_path / "m.xml").write_text("<mujoco><!-- a -- b --></mujoco>")
    with pytest.raises(ValueError, match=r"m\.xml: not well-formed"):
        read_shapes(tmp_path / "m.xml")
