"""What robots from MJCF files need of a world: loading, torques, centres of mass, contacts."""

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task.pybullet.sim import PybulletSim

pytestmark = pytest.mark.pybullet

ONE_LEG = """<mujoco model="leg"><worldbody><body name="torso" pos="0 0 2">
  <geom type="sphere" size="0.1"/>
  <body name="shin"><joint name="knee" type="hinge" axis="0 1 0" range="-90 90"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05"/></body>
</body></worldbody></mujoco>"""


@pytest.fixture
def sim():
    sim = PybulletSim(control_dt=0.0165, substeps=4, solver_iterations=5)
    yield sim
    sim.close()


@pytest.fixture
def leg(sim, tmp_path):
    file = tmp_path / "leg.xml"
    file.write_text(ONE_LEG)
    return sim.load("leg", file, self_collision=True)


def test_names_of_a_model(leg):
    assert leg.base_name == "torso"
    assert leg.joint_names == ["knee"]
    with pytest.raises(TaskError, match=r"^leg.xml has no joint 'nee'\. Did you mean 'knee'\? It has: knee\.$"):
        leg.find_joints(["nee"])
    with pytest.raises(TaskError, match=r"^leg.xml has no link 'shim'\. Did you mean 'shin'\? It has: "):
        leg.mass_state("shim")


def test_where_the_masses_are(leg):
    assert leg.mass_state("torso").position == (0, 0, 2)
    # Half of half a metre below the knee, which is in the torso's middle.
    assert leg.mass_state("shin").position == pytest.approx((0, 0, 1.75))
    assert leg.mass_positions(["shin"]) == [leg.mass_state("shin").position]
    with pytest.raises(TaskError, match=r"^leg.xml has no link 'shim'\. Did you mean 'shin'\? It has: "):
        leg.mass_positions(["shim"])
    leg.set_joints(np.array([np.pi / 2]))
    # About y from -z: to -x.
    assert leg.mass_state("shin").position == pytest.approx((-0.25, 0, 2), abs=1e-6)
    assert leg.mass_state("shin").roll_pitch_yaw[1] == pytest.approx(np.pi / 2, abs=1e-3)
    leg.set_joints(np.array([0.0]), np.array([2.0]))
    # 2 rad/s, 0.25 m below the axis
    assert leg.mass_state("shin").velocity == pytest.approx((-0.5, 0, 0), abs=1e-6)
    assert leg.mass_state("shin").angular_velocity == pytest.approx((0, 2, 0), abs=1e-6)


def test_what_was_read_is_read_again_after_a_step(sim, leg):
    assert leg.mass_state("torso").velocity == (0, 0, 0)
    sim.step()
    # 9.81 m/s^2 * 0.0165 s
    assert leg.mass_state("torso").velocity[2] == pytest.approx(-0.162, rel=0.01)
    assert leg.mass_state("torso").position[2] < 2


def test_gravity_of_the_built_world(sim, leg):
    sim.set_gravity(1.0)
    sim.step()
    assert leg.mass_state("torso").velocity[2] == pytest.approx(-0.0165, rel=0.01)


def test_torques(sim, leg):
    def speed_after(torque):
        leg.set_joints(np.zeros(1))
        leg.set_base((0, 0, 2))
        leg.set_torques(np.array([torque]))
        sim.step()
        return leg.joint_velocities[0]

    sim.set_gravity(0.0)
    leg.disable_motors()
    assert speed_after(0.0) == pytest.approx(0.0, abs=1e-9)
    assert speed_after(0.2) == pytest.approx(2 * speed_after(0.1), rel=0.01)
    assert speed_after(-0.1) == pytest.approx(-speed_after(0.1), rel=0.01)
    # A motor of half its strength gives half the torque.
    full = speed_after(0.2)
    leg.scale_motor_strength(0.5)
    assert speed_after(0.2) == pytest.approx(full / 2, rel=0.01)


def test_contacts_by_name(sim, leg):
    floor = sim.load("floor", "plane_stadium.sdf")
    assert leg.links_touching(floor) == set()
    for _ in range(60):
        sim.step()
    assert "shin" in leg.links_touching(floor)
    assert floor.links_touching(leg) == {"floor"}
    assert leg.links_touching(leg) == set()


def test_stiffer_contacts(sim):
    sim.load("floor", "plane_stadium.sdf")
    ball = sim.load("ball", "sphere_small.urdf")  # of 3 cm
    heights = []
    for erp in (0.2, 0.9):
        sim.set_contact_erp(erp)
        ball.set_base((0, 0, 0.02))
        sim.step()
        heights.append(ball.base_position[2])
    assert 0.02 < heights[0] < heights[1]


def test_a_model_says_itself_where_it_is(sim):
    with pytest.raises(TaskError, match=r"^ant.xml contains the pose of its body: position, orientation and "):
        sim.load("ant", "mjcf/ant.xml", position=(0, 0, 1))


def test_what_stays_where_it_is(sim):
    assert sim.load("hopper", "mjcf/hopper.xml").fixed  # its slides move, not its base
    assert not sim.load("ant", "mjcf/ant.xml").fixed


def test_a_file_of_two_bodies(sim, tmp_path):
    file = tmp_path / "two.xml"
    body = '<body name="{}" pos="{} 0 2"><geom type="sphere" size="0.1"/></body>'
    file.write_text(f'<mujoco model="two"><worldbody>{body.format("a", 0)}{body.format("b", 1)}</worldbody></mujoco>')
    with pytest.raises(TaskError, match=r"two.xml contains 2 bodies; split it into files of one body each$"):
        sim.load("two", file)


def test_a_model_that_is_none(sim, tmp_path):
    file = tmp_path / "broken.xml"
    file.write_text("not xml")
    with pytest.raises(TaskError, match=r"^PyBullet cannot load .*broken.xml: "):
        sim.load("robot", file)
