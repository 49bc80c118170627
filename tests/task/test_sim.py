"""The world: bodies and links by name, limits, pictures."""

import contextlib

import numpy as np
import pytest

import rlctl
from rlctl.errors import RecipeError, TaskError
from rlctl.task.env import TaskEnv
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.library import pybullet
from rlctl.task.pybullet.sim import PybulletSim
from rlctl_manipulation import reach
from rlctl_manipulation.reach import Reach
from tests.task import models
from tests.task.tasks import Slider

pytestmark = pytest.mark.pybullet


@pytest.fixture
def sim():
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    yield sim
    sim.close()


def test_a_model_file_that_is_not_there(sim):
    with pytest.raises(TaskError) as caught:
        sim.load("robot", "robot/missing.urdf")
    assert str(caught.value).startswith("model file 'robot/missing.urdf' not found: neither under /")
    assert str(caught.value).endswith(
        ", nor in pybullet_data; for a file next to your module: Path(__file__).with_name('missing.urdf')"
    )


def test_a_folder_is_no_model_file(sim, tmp_path):
    with pytest.raises(TaskError, match=r"^model file '.*' not found"):
        sim.load("robot", tmp_path)  # PyBullet crashes


def test_a_model_file_that_is_none(sim, tmp_path):
    file = tmp_path / "broken.urdf"
    file.write_text("not xml")
    with pytest.raises(TaskError, match=r"^PyBullet cannot load .*broken.urdf: "):
        sim.load("robot", file)


MESH = '<collision><geometry><mesh filename="meshes/hand.stl"/></geometry></collision>'


def test_what_pybullet_prints_of_a_model_is_in_the_error(sim, tmp_path):
    hand = models.link("hand", 1.0).replace("</link>", f"{MESH}</link>")
    with pytest.raises(TaskError, match=r"model\.urdf:1: cannot find 'meshes/hand\.stl' in any .* Link: hand failed"):
        sim.load("robot", models.urdf(tmp_path, hand))


def test_two_joints_of_one_name(sim, tmp_path):
    joints = models.joint("elbow", "a", "b"), models.joint("elbow", "b", "c")
    file = models.urdf(tmp_path, *(models.link(name, 1.0) for name in "abc"), *joints)
    with pytest.raises(TaskError, match=r"model\.urdf: 2 joints are called 'elbow'; give each its own name"):
        sim.load("robot", file)  # PyBullet crashes


def test_two_bodies_of_one_name(sim):
    sim.load("cube", "cube.urdf")
    with pytest.raises(TaskError, match=r"^a body 'cube' is already loaded; give each body its own name$"):
        sim.load("cube", "cube.urdf")


def test_names_of_links_and_bodies(sim):
    arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
    with pytest.raises(TaskError) as caught:
        arm.link_position("lbr_iiwa_lnk_7")
    assert str(caught.value).startswith(
        "kuka_iiwa.urdf has no link 'lbr_iiwa_lnk_7'. Did you mean 'lbr_iiwa_link_7'? It has: lbr_iiwa_link_1, "
    )
    with pytest.raises(TaskError, match=r"^no body 'amr'\. Did you mean 'arm'\? Loaded: arm\.$"):
        sim.body("amr")
    assert sim.body("arm") is arm


def test_a_link_called_base_is_not_the_base(sim, tmp_path):
    file = tmp_path / "two.urdf"
    file.write_text(
        """<robot name="two"><link name="world"/>
        <link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
        </inertial></link>
        <joint name="weld" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 2"/></joint>
        </robot>"""
    )
    body = sim.load("two", file, fixed=True)
    assert body.base_position.tolist() == [0, 0, 0]
    assert body.link_position("base").tolist() == [0, 0, 2]


def test_joints_are_read_where_they_were_set(sim):
    arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
    angles = np.linspace(-0.5, 0.5, 7)
    arm.set_joints(angles)
    np.testing.assert_allclose(arm.joint_positions, angles)
    np.testing.assert_allclose(arm.joint_velocities, 0.0)
    arm.set_joints(np.zeros(7), velocities=np.ones(7))
    np.testing.assert_allclose(arm.joint_velocities, 1.0)
    assert arm.joint_high[0] == pytest.approx(2.96706)  # [rad], as its URDF says


def test_a_fall_takes_the_time_it_should(sim):
    ball = sim.load("ball", "sphere_small.urdf", position=(0, 0, 10))
    for _ in range(30):
        sim.step()
    # After 0.5 s: 9.81 / 2 * 0.5**2 = 1.226 m, less 0.7 % by PyBullet's damping and as much by steps of 1/240 s.
    assert 10 - ball.base_position[2] == pytest.approx(1.226, rel=0.02)


def test_the_arm_keeps_its_speed_limits():
    env = TaskEnv(Reach())
    rng = np.random.default_rng(0)
    fastest = np.zeros(7)
    for seed in range(5):
        env.reset(seed=seed)
        for step in range(env.max_steps):
            if step % 10 == 0:
                action = rng.choice([-1.0, 1.0], 7)
            env.step(action)
            if pybullet.getContactPoints(physicsClientId=env.sim.client):
                break  # a blow may turn a joint faster than its motor does
            fastest = np.maximum(fastest, np.abs(env.task.arm.joint_velocities))
    env.close()
    assert (fastest <= reach.SPEED_LIMIT).all(), fastest / reach.SPEED_LIMIT
    assert (fastest > 0.5 * reach.MAX_SPEED).any()  # the actions did ask for it


def test_the_goal_is_in_the_picture():
    env = rlctl.make("reach", render_mode="rgb_array")
    env.reset(seed=0)
    pictures = []
    for y in (-0.3, 0.3, 0.3):
        env.unwrapped.task.goal = np.array([0.5, y, 0.5])
        pictures.append(env.render())
    left, right, again = pictures
    assert left.shape == (240, 320, 3)
    assert left.dtype == np.uint8
    np.testing.assert_array_equal(right, again)
    moved = (left != right).any(axis=2)
    assert 30 < moved.sum() < 2000  # two small spheres
    green = left[moved].astype(int)
    assert (green[:, 1] > green[:, 0] + 50).any()
    env.close()


def test_pictures_change_nothing():
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 7))

    def positions(mode):
        env = rlctl.make("reach", render_mode=mode)
        seen = [env.reset(seed=4)[0]]
        for number, action in enumerate(actions):
            seen.append(env.step(action)[0])
            if number % 20 == 0:
                env.render()
        env.close()
        return np.array(seen)

    np.testing.assert_array_equal(positions("rgb_array"), positions(None))


def test_markers_stay_through_full_resets():
    class Anew(Reach):
        fast_reset = False

    env = TaskEnv(Anew(), render_mode="rgb_array")
    env.reset(seed=0)
    env.reset(seed=1)
    assert pybullet.getNumBodies(physicsClientId=env.sim.client) == 3  # plane, arm, goal
    env.render()
    env.close()


def test_no_picture_without_a_mode():
    env = TaskEnv(Slider())
    env.reset(seed=0)
    assert env.render() is None
    env.close()
    with pytest.raises(RecipeError, match=r"^render_mode 'rgb' is not one of: human, rgb_array$"):
        TaskEnv(Slider(), render_mode="rgb")


def test_a_failing_build_leaves_no_client():
    class Broken(Slider):
        def build(self, sim):
            self.client = sim.client
            sim.load("x", "missing.urdf")

    task = Broken()
    with pytest.raises(TaskError, match="not found"):
        TaskEnv(task)
    assert not pybullet.isConnected(physicsClientId=task.client)


@pytest.mark.parametrize("engine", [PybulletSim, MujocoSim])
def test_a_base_is_placed_with_its_velocities(engine):
    half = np.sqrt(0.5)  # a quarter turn about z
    with contextlib.closing(engine(control_dt=1 / 60, substeps=4)) as sim:
        cube = sim.load("cube", "cube_small.urdf")
        cube.set_base(
            (0.0, 0.0, 1.0), (0.0, 0.0, half, half), velocity=(1.0, 2.0, 3.0), angular_velocity=(0.1, 0.2, 0.3)
        )
        assert cube.base_velocity == pytest.approx([1.0, 2.0, 3.0])
        assert cube.base_angular_velocity == pytest.approx([0.1, 0.2, 0.3])
        cube.set_base((0.0, 0.0, 1.0), angular_velocity=(0.1, 0.2, 0.3))
        assert cube.base_velocity == pytest.approx([0.0, 0.0, 0.0])
        cube.set_base((0.0, 0.0, 1.0))
        assert cube.base_angular_velocity.tolist() == [0.0, 0.0, 0.0]
