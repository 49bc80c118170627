"""What a person can do to worlds of both engines, and to plain environments; what the page draws of them."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rlctl.engine import MUJOCO, PYBULLET
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind
from rlctl.replaying.scene import BodyMotion, Scene
from rlctl.task.commands import CommandTerm
from rlctl.task.meshes import read_mesh
from rlctl_robot.play.controls import Wishes
from rlctl_robot.play.drawing import describe_shapes, list_poses
from rlctl_robot.play.robot_world import RobotWorld

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("sim", [pytest.param(PYBULLET, marks=pytest.mark.pybullet), MUJOCO], ids=str)
def test_pushes_and_friction(sim):
    with closing(EnvSpec("quadruped", sim=sim).make()) as env:
        world, task = RobotWorld(env), env.unwrapped.task
        env.reset(seed=0)
        world.begin()
        assert world.apply(Wishes(friction=0.3)) == ["friction of the ground 0.3"]
        assert world.apply(Wishes(friction=0.3)) == []
        mass = task.body.total_mass()
        # So that its speed changes by 0.5 m/s: 0.5 m/s * m / 0.1 s
        assert world.apply(Wishes(push=(0.0, -2.0))) == [f"push of {5 * mass:.3g} N for 0.1 s"]
        env.step(np.zeros(12, np.float32))
        assert task.body.base_velocity[1] < -0.05
        assert world.find_center() == pytest.approx(task.body.base_position.tolist())
        world.apply(Wishes(commands={"lin_vel_x": 9.0, "unknown": 1.0}))
        assert world.commands()["lin_vel_x"] == CommandTerm(0.7, 0.3, 0.7, "m/s")


def test_a_plain_environment_only_has_a_clock():
    with closing(EnvSpec("Pendulum-v1").make()) as env:
        world = RobotWorld(env)
        assert (world.can_push, world.can_change_friction, world.commands(), world.find_center()) == (
            False, False, {}, None
        )  # fmt: skip
        assert world.apply(Wishes(push=(1.0, 0.0), friction=0.1, commands={"a": 1.0})) == []


def test_a_command_without_a_range_names_itself():
    with closing(EnvSpec("reach", sim=MUJOCO).make()) as env:
        env.unwrapped.task.commands = lambda: {"height": CommandTerm(0.1, 1.0, 1.0, "m")}
        with pytest.raises(
            TaskError, match=r"^commands\(\): height is \(0.1, 1.0, 1.0, 'm', False\); give a value, an"
        ):
            RobotWorld(env).commands()


def describe(*shapes, **body):
    """Describe the shapes of a robot of two links that comes after the ground."""
    ground = BodyMotion(name="floor", file=Path(), ground_height=0.1, links=["floor"], positions=np.zeros((1, 1, 3)),
                        orientations=np.array([[UPRIGHT]]))  # fmt: skip
    robot = BodyMotion(name="robot", file=Path(), links=["base", "arm"], shapes=list(shapes),
                       positions=np.array([[[1.0, 0, 0], [np.nan] * 3]]), orientations=np.array([[UPRIGHT] * 2]),
                       **body)  # fmt: skip
    scene = Scene([ground, robot])
    return describe_shapes(scene), list_poses(scene)


def test_a_capsule_is_a_cylinder_with_balls(tmp_path):
    turned = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # the axis is along -y
    color = (1.0, 0.0, 0.0, 1.0)
    about, poses = describe(Shape("arm", ShapeKind.CAPSULE, (0.4, 0.05), None, (0.0, 0.0, 1.0), turned, color))
    assert about["ground"] == 0.1
    cylinder, *balls = about["parts"]
    assert (cylinder["kind"], cylinder["scale"], cylinder["link"]) == ("cylinder", [0.05, 0.05, 0.4], 2)
    ends = sorted(ball["pose"][:3] for ball in balls)
    assert ends == [pytest.approx([0, -0.2, 1]), pytest.approx([0, 0.2, 1])]
    assert [ball["scale"] for ball in balls] == [[0.05] * 3] * 2
    assert poses[7:14] == [1, 0, 0, *UPRIGHT]
    assert poses[14:17] == [-1000] * 3  # it does not exist now


def test_meshes(tmp_path):
    file = tmp_path / "square.obj"
    file.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1 2/2 -2/3 -1/4\n")
    points, triangles = read_mesh(file)
    assert triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    mesh = Mesh(points, triangles)
    shapes = [
        Shape("base", ShapeKind.MESH, (2.0, 2.0, 2.0), given, (0.0,) * 3, UPRIGHT, (1.0,) * 4) for given in (file, mesh)
    ]
    broken = Shape("base", ShapeKind.MESH, (1.0,) * 3, tmp_path / "no.obj", (0.0,) * 3, UPRIGHT, (1.0,) * 4)
    about, _ = describe(*shapes, broken)
    from_file, from_memory, missing = about["parts"]
    assert from_file == from_memory
    assert from_file["triangles"] == [0, 1, 2, 0, 2, 3]
    assert missing["triangles"] == []
    (tmp_path / "bad.obj").write_text("v 0 0 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="of points that it does not have"):
        read_mesh(tmp_path / "bad.obj")


def test_rough_ground_is_in_the_world_frame():
    points = np.stack([*np.meshgrid([0.0, 1.0], [0.0, 1.0], indexing="ij"), np.zeros((2, 2))], axis=-1)
    about, _ = describe(terrain=points)
    [part] = about["parts"]
    assert part["link"] == -1
    assert len(part["triangles"]) == 6


@pytest.mark.parametrize("direction", [(1e308, 1e308), (5e-324, 5e-324), (-3.0, -3.0)])
def test_a_push_has_a_direction_only(direction):
    with closing(EnvSpec("reach", sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        world = RobotWorld(env)
        mass = max(body.total_mass() for body in env.unwrapped.sim.bodies.values() if body.joint_names)
        assert world.apply(Wishes(push=direction)) == [f"push of {5 * mass:.3g} N for 0.1 s"]
