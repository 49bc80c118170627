"""Gears, points and frames held together."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task import Attachment
from rlctl.task.pybullet.sim import PybulletSim
from tests.task import models

pytestmark = pytest.mark.pybullet


@pytest.fixture
def sim():
    sim = PybulletSim(control_dt=1 / 60, substeps=4)
    yield sim
    sim.close()


@pytest.mark.parametrize("ratio", [1.0, -0.5, 3.0])
def test_a_gear_keeps_its_ratio(sim, tmp_path, ratio):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    sim.connect_gear(wheels, "left_joint", "right_joint", ratio=ratio)
    wheels.disable_motors()
    rng, widest = np.random.default_rng(0), 0.0
    for step in range(600):
        if step % 6 == 0:
            torque = rng.uniform(-0.02, 0.02, 1)
        wheels.set_torques(torque, joints=["left_joint"])
        sim.step()
        left, right = wheels.joint_positions
        assert abs(right - ratio * left) < np.radians(0.2)
        widest = max(widest, abs(left))
    assert widest > 0.5


def test_mistakes_in_a_gear(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    with pytest.raises(TaskError, match=r"^model.urdf has no joint 'letf_joint'. Did you mean 'left_joint'\?"):
        sim.connect_gear(wheels, "letf_joint", "right_joint", ratio=1.0)


def hang(sim, tmp_path, connect, **limits):
    """A cube of 0.1 kg on the tip of an arm, 1 m from the shoulder, which is held."""
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    cube = sim.load("cube", "cube_small.urdf", position=(1.05, 0, 0), inertia="shape")
    joined = connect(Attachment(arm, "tip"), Attachment(cube, "baseLink", (-0.05, 0.0, 0.0)), **limits)
    for _ in range(60):
        arm.drive_to(np.zeros(1))
        sim.step()
    return joined, arm, cube


def test_a_point_holds_and_lets_turn(sim, tmp_path):
    joined, arm, cube = hang(sim, tmp_path, sim.connect_point)
    assert joined.gap < 1.5e-3
    assert cube.base_position[2] < -0.01  # it swings below the tip
    assert joined.angle > 0.5
    assert arm.joint_torques[0] < -9.81  # what carries the arm alone


def test_a_fixed_frame_does_not_turn(sim, tmp_path):
    joined, arm, _ = hang(sim, tmp_path, sim.connect_fixed)
    assert joined.gap < 1.5e-3
    assert joined.angle < np.radians(0.5)
    # 9.81 N m of the arm, and 0.1 kg * 9.81 m/s^2 * 1.05 m of the cube
    assert arm.joint_torques[0] == pytest.approx(-(9.81 + 1.030), rel=1e-2)


@pytest.mark.parametrize(("force", "holds"), [(1.1, True), (0.8, False)])
def test_the_force_of_a_constraint(sim, tmp_path, force, holds):
    # The cube weighs 0.1 kg * 9.81 m/s^2 = 0.981 N; it is hung up by its middle, so that it does not swing.
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    cube = sim.load("cube", "cube_small.urdf", position=(1.0, 0, 0), inertia="shape")
    joined = sim.connect_point(Attachment(arm, "tip"), Attachment(cube, "baseLink"), max_force=force)
    for _ in range(60):
        arm.drive_to(np.zeros(1))
        sim.step()
    assert (joined.gap < 0.01) == holds


def test_frames_that_are_apart(sim, tmp_path):
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    cube = sim.load("cube", "cube_small.urdf", position=(1.2, 0, 0), inertia="shape")
    with pytest.raises(TaskError) as caught:
        sim.connect_point(Attachment(arm, "tip"), Attachment(cube, "baseLink"))
    assert str(caught.value) == (
        "constraint: 'tip' of 'arm' and 'baseLink' of 'cube' are 0.2 m apart, too far to connect them. "
        "Place them with set_joints first."
    )


def test_a_link_or_a_world_that_is_not_there(sim, tmp_path):
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    with pytest.raises(TaskError, match=r"^model.urdf has no link 'tipp'. Did you mean 'tip'\?"):
        sim.connect_point(Attachment(arm, "tipp"), Attachment(arm, "base"))
    with pytest.raises(TaskError, match=r"^no body 'cube'\. Loaded: arm\.$"):
        sim.connect_point(Attachment(arm, "tip"), Attachment(sim.body("cube"), "baseLink"))


def test_constraints_after_a_restore(sim, tmp_path):
    """Two gears, a point; 200 steps, bit for bit."""
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    sim.connect_gear(wheels, "left_joint", "right_joint", ratio=2.0)
    cube = sim.load("cube", "cube_small.urdf", position=(0.3, 0, 0), inertia="shape")
    sim.connect_point(Attachment(wheels, "right", (0.1, 0.0, 0.0)), Attachment(cube, "baseLink"))
    wheels.disable_motors()
    sim.save()

    def play():
        sim.restore()
        rng, rows = np.random.default_rng(0), []
        for _ in range(200):
            wheels.set_torques(rng.uniform(-0.05, 0.05, 2))
            sim.step()
            rows.append(np.r_[wheels.joint_positions, wheels.joint_velocities, cube.base_position])
        return np.array(rows)

    first = play()
    assert np.ptp(first[:, 0]) > 0.1
    np.testing.assert_array_equal(play(), first)
