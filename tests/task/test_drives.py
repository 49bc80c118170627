"""`set_drives`: the same springs and dampers in both engines."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim

pytest.importorskip("mujoco")
STIFFNESS = [300.0, 300.0, 300.0, 300.0, 5.0, 5.0, 0.5]  # [N m/rad]
DAMPING = [5.0, 5.0, 2.0, 2.0, 0.1, 0.1, 0.01]  # [N m s/rad]
ENGINES = [pytest.param(PybulletSim, marks=pytest.mark.pybullet), MujocoSim]


def answer_a_step(engine, substeps=10):
    """Return the positions of the iiwa's joints after a step of their targets by 0.2 rad, every 20 ms for 1.2 s."""
    with closing(engine(control_dt=0.02, substeps=substeps)) as sim:
        sim.set_gravity(0.0)
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        arm.set_joints(np.full(7, 0.2))
        arm.set_drives(STIFFNESS, DAMPING)
        sim.save()
        rows = []
        for _ in range(60):
            arm.drive_to(np.full(7, 0.4), max_force=1000.0)
            sim.step()
            rows.append(arm.joint_positions)
        return np.array(rows)


@pytest.mark.pybullet
def test_both_engines_move_alike():
    bullet, mujoco = (answer_a_step(engine) for engine in (PybulletSim, MujocoSim))
    assert np.abs(bullet - mujoco).max() < 0.02  # of 0.2 rad
    np.testing.assert_allclose(bullet[-1, :5], 0.4, atol=0.03)
    np.testing.assert_allclose(mujoco[-1, :5], 0.4, atol=0.03)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_spring_gives_way_to_a_load(engine):
    with closing(engine(control_dt=0.02, substeps=10)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        pose = np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0])  # stretched out, horizontal
        arm.set_joints(pose)
        arm.set_drives(STIFFNESS, DAMPING)
        sim.save()
        for _ in range(200):
            arm.drive_to(pose, max_force=1000.0)
            sim.step()
        sag, torque = arm.joint_positions[1] - pose[1], arm.joint_torques[1]
    # Hooke's law: the sag is the torque over the stiffness. The links weigh tens of N m.
    assert abs(torque) > 20.0
    assert sag == pytest.approx(-torque / STIFFNESS[1], rel=0.1)


@pytest.mark.parametrize(
    ("engine", "worlds"),
    [pytest.param(PybulletSim, None, marks=pytest.mark.pybullet), (MujocoSim, None), (MujocoSim, 3)],
)
def test_ideal_motors_hold_an_arm_that_is_told_to_stay_where_it_is(engine, worlds):
    """Actions that are steps from the measured angle would let it sink, a little in each step."""
    with closing(engine(control_dt=0.02, substeps=4, **({} if worlds is None else {"worlds": worlds}))) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        sim.save()
        pose = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 0.5, 0.0])
        arm.set_joints(pose if worlds is None else np.tile(pose, (worlds, 1)))
        for _ in range(100):
            arm.drive_to(arm.joint_positions)
            sim.step()
        assert np.abs(arm.joint_positions - pose).max() < 0.01  # [rad]; it sank by 0.1 rad without the feed-forward


@pytest.mark.parametrize("engine", ENGINES)
def test_they_describe_themselves_to_controllers(engine):
    with closing(engine(control_dt=0.02, substeps=4)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        assert arm.describe_joints(arm.joint_names).stiffness == ()
        arm.set_drives(STIFFNESS, DAMPING)
        joints = arm.describe_joints(arm.joint_names[4:])
    assert joints.stiffness == tuple(STIFFNESS[4:])
    assert joints.damping == tuple(DAMPING[4:])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("stiffness", [[1.0, 2.0], -1.0, np.nan])
def test_a_stiffness_that_cannot_be(engine, stiffness):
    with closing(engine(control_dt=0.02, substeps=4)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        with pytest.raises(
            TaskError, match=r"kuka_iiwa.urdf: stiffness .* is not one number, or one for each of 7 joints"
        ):
            arm.set_drives(stiffness, 1.0)


@pytest.mark.pybullet
def test_a_damping_that_explicit_steps_cannot_have():
    with closing(PybulletSim(control_dt=0.02, substeps=1)) as sim:
        arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
        with pytest.raises(TaskError, match=r"PyBullet's steps of 0.02 s: use \d+ times as many substeps"):
            arm.set_drives(300.0, 100.0)
