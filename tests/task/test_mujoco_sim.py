"""Worlds of tasks in MuJoCo: the same models, starts and motors as in PyBullet, and bit-exact resets."""

import ctypes.util
import os
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest

from rlctl.engine import MUJOCO, PYBULLET
from rlctl.environments.spec import EnvSpec
from rlctl.errors import TaskError
from rlctl.task import worlds as worlds_module
from rlctl.task.env import TaskEnv
from rlctl.task.mujoco.opengl import draw_without_display
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim
from rlctl_manipulation.peg_insert import SCARA
from tests.importing.foreign.policies import write_scene
from tests.task import models
from tests.task.tasks import Cart, Slider

pytest.importorskip("mujoco")

TASKS = ["reach", "reach-sparse", "quadruped", "biped", "biped-3d", "peg-insert", "screw-drive", "gear-arm"]


def play(env, steps: int = 40):
    """Play random actions; return all observations, the reset's first."""
    observations = [env.reset(seed=3)[0]]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        observation, _, terminated, _, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
        observations.append(observation)
        if terminated:
            break
    return [np.concatenate([*part.values()]) if isinstance(part, dict) else part for part in observations]


@pytest.mark.slow_except("reach", "peg-insert")
@pytest.mark.pybullet
@pytest.mark.parametrize("task", TASKS)
def test_an_episode_starts_as_in_pybullet_and_repeats_bit_for_bit(task):
    with closing(EnvSpec(task, sim=PYBULLET).make()) as env:
        bullet = play(env, steps=0)[0]
        joints = env.unwrapped.task.describe_joints()
    with closing(EnvSpec(task, sim=MUJOCO).make()) as env:
        first = play(env)
        again = play(env)
        described = env.unwrapped.task.describe_joints()
    with closing(EnvSpec(task, sim=MUJOCO).make()) as env:
        fresh = play(env)
    np.testing.assert_allclose(first[0], bullet, atol=1e-5)
    assert described.names == joints.names
    assert described.max_torque == pytest.approx(joints.max_torque)
    assert np.array_equal(first, again)
    assert np.array_equal(first, fresh)


@pytest.fixture
def weightless_arm():
    sim = MujocoSim(control_dt=1 / 60, substeps=4, solref=0.02)
    arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
    sim.model.opt.gravity[:] = 0.0
    arm.cap_joint_speed(np.inf)
    return sim, arm


def test_a_position_motor_takes_about_the_same_part_of_the_error_away(weightless_arm):
    sim, arm = weightless_arm
    sim.save()
    arm.drive_to(np.ones(7), gain=0.1, max_force=1e5, max_speed=1e3)
    for _ in range(6):
        sim.step()
    # PyBullet's takes a tenth of 1 rad in each of 24 substeps: 0.9 ** 24 = 0.08 is left.
    assert 1 - arm.joint_positions == pytest.approx(np.full(7, 0.08), abs=0.1)


def test_a_position_motor_keeps_its_top_speed(weightless_arm):
    sim, arm = weightless_arm
    sim.save()
    for _ in range(30):
        arm.drive_to(np.ones(7), gain=0.1, max_force=1e5, max_speed=0.6)
        sim.step()
        assert np.abs(arm.joint_velocities).max() < 0.61
    # 0.6 rad/s for half a second, less what the start takes.
    assert arm.joint_positions == pytest.approx(np.full(7, 0.3), abs=0.06)


def test_a_velocity_motor_and_brakes(weightless_arm):
    sim, arm = weightless_arm
    wanted = np.array([0.5, 0, 0, 0, 0, 0, 0])
    sim.save()
    arm.drive_at(wanted, max_force=1e4)
    sim.step()
    sim.step()
    assert arm.joint_velocities == pytest.approx(wanted, abs=2e-3)


@pytest.mark.pybullet
def test_frictions_are_multiplied_and_restored():
    with closing(TaskEnv(Cart(), sim=MUJOCO)) as env:
        cube, plane = env.task.cube, env.task.plane
        env.reset(seed=0)
        nominal = env.sim.model.pair_friction.copy()
        plane.set_friction(0.5)
        cube.set_friction(0.8)
        assert env.sim.model.pair_friction[0, :2] == pytest.approx(0.4)
        env.reset(seed=0)
        assert np.array_equal(env.sim.model.pair_friction, nominal)


def test_feet_have_the_spinning_friction_of_their_file():
    with closing(EnvSpec("biped-3d", sim=MUJOCO).make()) as env:
        # 0.04 m of the two feet, times the ground's friction of 1; the other links have none.
        spins = np.sort(env.unwrapped.sim.model.pair_friction[:, 2])
    assert spins[-2:] == pytest.approx(0.04)
    assert spins[:-2] == pytest.approx(0.0, abs=1e-4)


def test_inverse_kinematics_depend_on_the_present_joints_and_model_only(tmp_path):
    hand, wanted, down = "lbr_iiwa_link_7", np.array([0.5, 0.2, 0.5]), (1.0, 0.0, 0.0, 0.0)
    home = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0])
    with closing(MujocoSim(control_dt=1 / 60, substeps=4)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        arm.set_joints(home)
        first = arm.solve_inverse_kinematics(hand, wanted, down)
        arm.solve_inverse_kinematics(hand, [0.4, -0.3, 0.6])
        assert arm.joint_positions == pytest.approx(home)
        assert np.array_equal(arm.solve_inverse_kinematics(hand, wanted, down), first)
        sim.load("cart", models.cart(tmp_path))  # a free body: the model has more joints now
        arm.set_joints(home)
        assert arm.solve_inverse_kinematics(hand, wanted, down) == pytest.approx(first, abs=1e-9)
        arm.set_joints(first)
        assert arm.link_position(hand) == pytest.approx(wanted, abs=2e-4)


@pytest.mark.pybullet
@pytest.mark.parametrize("world", [PybulletSim, MujocoSim])
def test_a_force_sensor_measures_what_hangs_from_it(world):
    options = {"solref": 0.02} if world is MujocoSim else {}
    with closing(world(control_dt=1 / 60, substeps=4, **options)) as sim:
        arm = sim.load("arm", SCARA, fixed=True)
        arm.add_force_sensor("sensor")
        sim.save()
        arm.drive_at(np.zeros(4))
        for _ in range(60):
            sim.step()
        force = arm.joint_reaction("sensor")[:3]
    # Peg and tip, below the sensor, weigh 51 g.
    assert force == pytest.approx([0.0, 0.0, 9.81 * 0.051], abs=0.01)


@pytest.mark.pybullet
@pytest.mark.parametrize("world", [PybulletSim, MujocoSim])
def test_a_contact_sensor_tells_which_link_touches(world):
    options = {"solref": 0.02} if world is MujocoSim else {}
    with closing(world(control_dt=0.02, substeps=4, **options)) as sim:
        sim.load("ground", "plane.urdf", fixed=True)
        cube = sim.load("cube", "cube_small.urdf", position=(0.0, 0.0, 0.1))
        cube.add_contact_sensor(cube.base_name)
        sim.save()
        sim.step()
        assert not cube.touches(cube.base_name)
        for _ in range(20):
            sim.step()
        assert cube.touches(cube.base_name)
        with pytest.raises(TaskError, match=r"link 'top' has no contact sensor: call add_contact_sensor\('top'\)"):
            cube.touches("top")


def test_a_base_without_mass_and_a_floor_that_is_a_body(tmp_path):
    with closing(MujocoSim(control_dt=0.02, substeps=4)) as sim:
        robot = sim.load("robot", write_scene(tmp_path), floor=False)
        sim.save()
        assert robot.link_names == ["trunk", "left", "right"]
        robot.set_base((0.0, 0.0, 2.0))
        assert robot.base_position == pytest.approx([0.0, 0.0, 2.0])
        assert robot.link_position("left") == pytest.approx([0.0, 0.1, 1.9])


def test_gears_and_a_linkage_hold():
    with closing(EnvSpec("gear-arm", sim=MUJOCO).make()) as env:
        play(env)
        task = env.unwrapped.task
        positions = dict(zip(task.arm.joint_names, task.arm.joint_positions, strict=True))
        assert task.linkage.gap < 2e-3
    for joint in ("turn", "shoulder", "crank"):
        assert positions[joint] == pytest.approx(positions[f"{joint}_motor"] / 3, abs=1e-3)
    assert positions["wrist"] == pytest.approx(-positions["crank"], abs=1e-3)


def test_events_act_in_mujoco_too():
    masses = []
    for events in ({}, {"mass": {"factor": (1.5, 1.5)}}):
        with closing(EnvSpec("reach", events=events, sim=MUJOCO).make()) as env:
            env.reset(seed=0)
            masses.append(float(env.unwrapped.sim.model.body_mass.sum()))
    assert masses[1] > 1.2 * masses[0]


@pytest.mark.pybullet
@pytest.mark.parametrize(
    ("task", "parameters", "missing"),
    [("tests.task.tasks:Stadium", {}, "plane_stadium.sdf: MuJoCo reads URDF and MJCF")],
)
def test_what_mujoco_has_not_is_named(task, parameters, missing):
    with pytest.raises(TaskError, match=missing):
        EnvSpec(task, parameters, sim=MUJOCO).make()


needs_egl = pytest.mark.skipif(ctypes.util.find_library("EGL") is None, reason="needs libEGL")


@pytest.mark.slow
@needs_egl
def test_markers_are_drawn_where_they_are_moved():
    with closing(EnvSpec("reach", sim=MUJOCO).make("rgb_array")) as env:
        env.reset(seed=0)
        pictures = []
        for y in (-0.3, 0.3, 0.3):
            env.unwrapped.task.goal = np.array([0.5, y, 0.5])
            pictures.append(env.render())
    left, right, again = pictures
    assert left.shape == (240, 320, 3)
    np.testing.assert_array_equal(right, again)
    assert 30 < (left != right).any(axis=2).sum() < 2000  # two small spheres


@pytest.mark.slow
@needs_egl
def test_a_near_body_is_drawn_whole_on_wide_ground():
    with closing(MujocoSim(control_dt=0.02, substeps=4)) as sim:
        sim.add_height_field("ground", np.tile([0.0, 0.01], (20, 10)), cell=5.0)  # 100 m x 100 m
        cube = sim.load("cube", "cube_small.urdf", position=(0.0, 0.0, 0.5))
        looking = {"eye": (0.5, 0.0, 0.5), "target": (0.0, 0.0, 0.5)}
        seen = sim.render(64, 48, **looking)
        cube.set_base((0.0, 0.0, 5.0))
        without = sim.render(64, 48, **looking)
    assert (seen != without).any(axis=2).sum() > 30


@pytest.mark.slow
@needs_egl
def test_a_task_draws_without_a_display(monkeypatch):
    # In a process of its own: MuJoCo chooses at its import how to draw, and GLFW would end the process.
    for name in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    code = "import rlctl; env = rlctl.make('reach', sim='mujoco'); "
    code += "env.reset(seed=0); print(env.unwrapped.sim.render().shape)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=250)
    assert done.stdout == "(240, 320, 3)\n", done.stderr


DRAWS = """
import gymnasium, mujoco
class Camera(gymnasium.Env):
    action_space = observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    def __init__(self):
        model = mujoco.MjModel.from_xml_string("<mujoco/>")
        print(mujoco.Renderer(model, 8, 8).render().shape)
    def reset(self, seed=None, options=None): ...
    def step(self, action): ...
"""


@pytest.mark.slow
@needs_egl
def test_a_constructor_draws_without_a_display(monkeypatch, tmp_path):
    for name in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "camera.py").write_text(DRAWS)
    code = f"from rlctl.environments.spec import EnvSpec; EnvSpec('{tmp_path}/camera.py:Camera').make()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=250)
    assert done.stdout == "(8, 8, 3)\n", done.stderr


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_only_linux_is_told_to_draw_by_egl(platform, monkeypatch):
    monkeypatch.setattr(sys, "platform", platform)
    for name in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    draw_without_display()
    assert "MUJOCO_GL" not in os.environ


def test_an_engine_is_chosen_by_what_is_installed(monkeypatch):
    installed = worlds_module.is_installed()
    with closing(TaskEnv(Slider())) as env:
        assert env.sim.engine == ("PyBullet" if installed else "MuJoCo")
    monkeypatch.setattr(worlds_module, "is_installed", lambda: False)
    with closing(TaskEnv(Slider())) as env:
        assert env.sim.engine == "MuJoCo"


def test_a_slippery_ground_is_solved_further_until_the_reset():
    with closing(EnvSpec("walk", sim=MUJOCO).make()) as env:
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        task, world = env.unwrapped.task, env.unwrapped.sim.world
        iterations = world.mj_model.opt.iterations
        task.ground.set_friction(0.0)
        assert world.mj_model.opt.iterations == 50 > iterations
        assert world.mj_model.pair_friction[:, :2].min() == 1e-3
        for _ in range(30):
            env.step(0.2 * rng.uniform(-1.0, 1.0, 12).astype(np.float32))
            assert np.abs(task.body.base_velocity).max() < 10.0
        env.reset(seed=1)
        assert world.mj_model.opt.iterations == iterations


def test_changes_before_a_further_load_are_kept(tmp_path):
    with closing(MujocoSim(control_dt=0.02, substeps=4)) as sim:
        sim.load("ground", "plane.urdf", fixed=True)
        wheels = sim.load("wheels", models.two_wheels(tmp_path))
        box = sim.load("box", "cube_small.urdf", position=(0.0, 0.0, 0.5))
        wheels.set_joint_damping(0.7)
        wheels.scale_motor_strength(0.5)
        box.set_color((0.1, 0.2, 0.3))
        box.set_contact_stiffness(500.0)
        (stiff,) = sim.model.pair_solref.copy()  # of the ground and the box
        sim.load("cube", "cube_small.urdf", position=(1.0, 0.0, 0.1))
        joints = [sim.model.joint(f"wheels/{name}").id for name in wheels.joint_names]
        assert sim.model.dof_damping[sim.model.jnt_dofadr[joints]] == pytest.approx([0.7, 0.7])
        motors = [sim.model.actuator(f"wheels/motor {name}").id for name in wheels.joint_names]
        assert sim.world.extra["strength"][motors] == pytest.approx([0.5, 0.5])
        link = sim.model.body(f"box/{box.base_name}").id
        assert sim.model.geom_rgba[sim.model.geom_bodyid == link, :3][0] == pytest.approx((0.1, 0.2, 0.3))
        assert sim.world.extra["color"][link] == pytest.approx((0.1, 0.2, 0.3))
        on_ground = (sim.model.geom_bodyid[sim.model.pair_geom2] == link) & (sim.model.pair_geom1 == 0)
        assert sim.model.pair_solref[on_ground] == pytest.approx(stiff[None])
        assert sim.model.pair_solref[~on_ground, 0] == pytest.approx(sim.model.pair_solref[~on_ground, 0].clip(0.0))


def test_friction_of_contacts_is_that_of_their_links():
    sim = MujocoSim(control_dt=0.02, substeps=4)
    sim.load("ground", "plane.urdf", fixed=True)
    sim.load(
        "robot", "a1.urdf", position=(0.0, 0.0, 1.0), self_collision=True
    )  # its pairs are compiled in another order
    cube = sim.load("cube", "cube_small.urdf")
    cube.set_friction(0.123)
    model, friction = sim.model, sim.fields.model("friction")
    one, two = model.geom_bodyid[model.pair_geom1], model.geom_bodyid[model.pair_geom2]
    np.testing.assert_allclose(model.pair_friction[:, 0], friction[one] * friction[two])
    assert (friction[one] * friction[two] == 0.123).any()
