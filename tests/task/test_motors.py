"""Driving joints: targets, speeds, torques, some joints only; what the motors give and what joints carry."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.pybullet.sim import PybulletSim
from tests.task import models

pytestmark = pytest.mark.pybullet


@pytest.fixture(params=[1, 4], ids=["1 substep", "4 substeps"])
def sim(request):
    sim = PybulletSim(control_dt=1 / 60, substeps=request.param)
    yield sim
    sim.close()


def test_what_holds_an_arm_up(sim, tmp_path):
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    arm.add_force_sensor("weld")
    for _ in range(60):
        arm.drive_to(np.zeros(1))
        sim.step()
    # About the shoulder, y axis: -(1 kg * 0.5 m + 0.5 kg * 1 m) * 9.81 m/s^2
    assert arm.joint_torques == pytest.approx([-9.81], abs=1e-3)
    # 0.5 kg * 9.81 m/s^2, through its centre
    assert arm.joint_reaction("weld") == pytest.approx([0, 0, 4.905, 0, 0, 0], abs=2e-3)


def test_a_sensor_that_was_not_added(sim, tmp_path):
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    with pytest.raises(
        TaskError, match=r"^joint 'weld' has no force sensor: call add_force_sensor\('weld'\) in build$"
    ):
        arm.joint_reaction("weld")
    with pytest.raises(TaskError, match=r"^model.urdf has no joint 'wled'. Did you mean 'weld'\? It has: shoulder, we"):
        arm.add_force_sensor("wled")


def test_a_motor_gives_no_more_than_its_force(sim, tmp_path):
    arm = sim.load("arm", models.arm(tmp_path), fixed=True)
    for _ in range(60):
        arm.drive_to(np.zeros(1), max_force=[5.0])
        sim.step()
    assert arm.joint_torques == pytest.approx([-5.0])
    assert arm.joint_positions[0] > 0.5  # it falls


def test_a_limit_may_be_one_number_for_all_joints(sim, tmp_path):
    one, two = (sim.load(name, models.two_wheels(tmp_path), fixed=True) for name in ("one", "two"))
    for _ in range(3):
        one.drive_to(np.ones(2), max_speed=2.0, max_force=np.float32(0.5), gain=0.3)
        two.drive_to(np.ones(2), max_speed=[2.0, 2.0], max_force=[0.5, 0.5], gain=0.3)
        sim.step()
    assert one.joint_positions.tolist() == two.joint_positions.tolist()
    one.drive_at(np.ones(2), max_force=0.5)
    two.drive_at(np.ones(2), max_force=[0.5, 0.5])
    sim.step()
    assert one.joint_velocities.tolist() == two.joint_velocities.tolist()


def test_set_torques_are_what_is_given(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    wheels.disable_motors()
    wheels.set_torques(np.array([0.001]), joints=["right_joint"])
    sim.step()
    assert wheels.joint_torques[1] == 0.001
    # 0.001 N m / (0.2 kg * (0.02^2 / 6 + 0.05^2) m^2) * 1/60 s = 0.0325 rad/s; nothing turns the other
    assert wheels.joint_velocities == pytest.approx([0, 0.0325], abs=2e-4)


def test_speeds_of_some_joints(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    for _ in range(30):
        wheels.drive_at(np.array([2.0]), joints=["right_joint"])
        wheels.drive_to(np.array([0.3]), joints=["left_joint"], gain=0.3)
        sim.step()
    assert wheels.joint_velocities == pytest.approx([0, 2], abs=1e-2)
    assert wheels.joint_positions == pytest.approx([0.3, 1.0], abs=0.05)  # 2 rad/s for 0.5 s
    with pytest.raises(TaskError, match=r"^model.urdf has no joint 'rigth_joint'. Did you mean 'right_joint'\?"):
        wheels.drive_at(np.array([2.0]), joints=["rigth_joint"])


def test_the_speed_limits_of_the_file(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    assert wheels.joint_max_speed.tolist() == [5, 5]
    fastest = 0.0
    for _ in range(12):
        wheels.drive_to(np.array([2.5, -2.5]), gain=1.0)
        sim.step()
        fastest = max(fastest, np.abs(wheels.joint_velocities).max())
    assert 4.5 < fastest <= 5.001  # rad/s, of the motors
    wheels.disable_motors()
    for _ in range(12):
        wheels.set_torques(np.array([1.0, -1.0]))
        sim.step()
    assert np.abs(wheels.joint_velocities) == pytest.approx([5, 5])  # and of whatever pushes


def test_no_damping_to_scale(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    with pytest.raises(TaskError, match=r"^model.urdf: these joints have no damping to scale; use set_joint_damping$"):
        wheels.scale_joint_damping(1.2)


def test_torques_of_a_joint_that_its_motor_holds(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    left, right = wheels.joint_names
    wheels.disable_motors([right])
    wheels.set_torques(np.ones(1), [right])
    with pytest.raises(TaskError, match=rf"^set_torques: the motor of '{left}' holds it in place; call disable_motors"):
        wheels.set_torques(np.ones(2))


def test_a_value_too_few_or_too_many(sim, tmp_path):
    wheels = sim.load("wheels", models.two_wheels(tmp_path), fixed=True)
    message = r"^model.urdf: {} of shape \({},\) for {} joints; joint_names of the body has all$"
    for call, values, count in [
        (wheels.set_joints, ("positions", 3), 2),
        (wheels.drive_to, ("positions", 3), 2),
        (wheels.drive_at, ("velocities", 1), 2),
        (wheels.set_torques, ("torques", 3), 2),
        (lambda values: wheels.set_joints(np.zeros(2), values), ("velocities", 3), 2),
        (lambda values: wheels.drive_to(np.zeros(2), max_speed=values), ("max_speed", 3), 2),
        (
            lambda values: wheels.drive_at(np.zeros(1), max_force=values, joints=wheels.joint_names[:1]),
            ("max_force", 2),
            1,
        ),
    ]:
        with pytest.raises(TaskError, match=message.format(*values, count)):
            call(np.ones(values[1]))
    wheels.set_joints([0.1, 0.2])  # a list will do
    assert wheels.joint_positions == pytest.approx([0.1, 0.2])
    for speed in (1.0, 2.0):  # and an array of its own for each call
        wheels.drive_to(np.zeros(2), max_speed=np.full(2, speed), max_force=np.full(2, 3.0))


def test_inverse_kinematics(sim):
    arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
    home = np.array([0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0])
    arm.set_joints(home)
    wanted = np.array([0.5, 0.2, 0.5])
    down = (1.0, 0.0, 0.0, 0.0)  # [quaternion], the hand's z axis points to the floor
    solution = arm.solve_inverse_kinematics("lbr_iiwa_link_7", wanted, down)
    assert arm.joint_positions.tolist() == home.tolist()  # looked for, not moved
    arm.set_joints(solution)
    np.testing.assert_allclose(arm.link_position("lbr_iiwa_link_7"), wanted, atol=2e-4)
    assert abs(np.dot(arm.link_orientation("lbr_iiwa_link_7"), down)) == pytest.approx(1, abs=1e-3)
    np.testing.assert_array_equal(solution, _solve_anew(home, wanted, down))


def _solve_anew(home, wanted, down):
    sim = PybulletSim(control_dt=1 / 60, substeps=1)
    arm = sim.load("arm", "kuka_iiwa.urdf", fixed=True)
    for start in (home + 0.3, home):  # what was solved before changes nothing
        arm.set_joints(start)
        solution = arm.solve_inverse_kinematics("lbr_iiwa_link_7", wanted, down)
    sim.close()
    return solution


def test_contact_forces(sim):
    floor = sim.load("floor", "plane.urdf", fixed=True)
    cube = sim.load("cube", "cube_small.urdf", position=(0, 0, 0.025), inertia="shape")
    for _ in range(60):
        sim.step()
    contacts = cube.contacts_with(floor)
    assert set(contacts.links) == {"baseLink"}
    assert contacts.forces.sum() == pytest.approx(0.981, rel=1e-3)  # 0.1 kg * 9.81 m/s^2
    assert -1e-4 < contacts.distances.min() < 1e-4
    assert sim.deepest_contact == pytest.approx(max(0.0, -contacts.distances.min()))
    assert cube.contacts_with(cube) == ([], pytest.approx(np.zeros(0)), pytest.approx(np.zeros(0)))
    cube.set_base((0, 0, 0.02))
    sim.step()
    assert cube.contacts_with(floor).distances.min() == pytest.approx(-0.005, rel=0.3)  # [m], 5 mm deep


def test_a_joint_without_limits_has_infinite_ones(sim, tmp_path):
    wheel = models.joint("wheel", "base", "left", kind="continuous").replace('lower="-3" upper="3" ', "")
    file = models.urdf(tmp_path, models.link("base", 1.0), models.link("left", 0.2), wheel)
    body = sim.load("cart", file, fixed=True)
    assert (body.joint_low[0], body.joint_high[0]) == (-np.inf, np.inf)
    assert body.describe_joints(["wheel"]).low == ()
