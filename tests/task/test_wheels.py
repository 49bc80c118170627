"""Robots on wheels: both engines roll, turn, spin and brake them alike."""

from contextlib import closing

import numpy as np
import pytest

from rlctl.errors import UsageError
from rlctl.task.mujoco.sim import MujocoSim
from rlctl.task.pybullet.sim import PybulletSim
from rlctl.task.urdf import read_urdf
from tests.task import models

pytest.importorskip("mujoco")
ENGINES = [pytest.param(PybulletSim, marks=pytest.mark.pybullet), MujocoSim]
BOTH = np.ones(2)


@pytest.fixture(params=ENGINES)
def sim(request):
    with closing(request.param(control_dt=0.02, substeps=4)) as sim:
        yield sim


def load_cart(sim, tmp_path, *, contact="", height=0.1):
    sim.load("ground", "plane.urdf", fixed=True)
    cart = sim.load("cart", models.cart(tmp_path, contact), position=(0.0, 0.0, height))
    cart.disable_motors()
    sim.save()
    return cart


def roll(sim, cart, torques, steps=50):
    for _ in range(steps):
        cart.set_torques(np.asarray(torques))
        sim.step()


def test_a_small_torque_rolls_them(sim, tmp_path):
    cart = load_cart(sim, tmp_path)
    roll(sim, cart, 0.02 * BOTH)
    # 2 * 0.02 N m / 0.1 m = 0.4 N moves 4.8 kg and 2 * 0.002 kg m^2 / (0.1 m)^2: 0.077 m/s^2, 0.038 m in 1 s.
    # A prism of 32 sides, which PyBullet makes of a cylinder, rolls in jerks, 40 % further.
    assert cart.base_position[0] == pytest.approx(0.0385, rel=0.02)


def test_they_roll_on(sim, tmp_path):
    cart = load_cart(sim, tmp_path)
    roll(sim, cart, 1.0 * BOTH, steps=10)
    speed = cart.base_velocity[0]
    roll(sim, cart, 0.0 * BOTH, steps=100)
    assert speed > 0.5
    assert cart.base_velocity[0] == pytest.approx(speed, rel=0.1)  # the body swings; PyBullet's drag took 32 %


def test_their_edges_resist_turning(sim, tmp_path):
    cart = load_cart(sim, tmp_path)
    # Each wheel carries 23.5 N, half of it at an edge 15 mm from the middle: 0.35 N m. Torques of 0.2 N m give
    # 2 * 0.2 N m / 0.1 m * 0.15 m = 0.6 N m, less than the 0.7 N m of both; those of 0.4 N m are more.
    roll(sim, cart, [0.2, -0.2])
    assert abs(cart.base_angular_velocity[2]) < 0.05
    roll(sim, cart, [0.4, -0.4])
    assert abs(cart.base_angular_velocity[2]) > 5.0


def test_their_rolling_friction_is_that_of_the_file(sim, tmp_path):
    cart = load_cart(sim, tmp_path, contact='<rolling_friction value="0.002"/>')
    roll(sim, cart, 0.2 * BOTH)
    # Without it 0.388 m. 0.002 m * 23.5 N = 0.047 N m of each wheel's 0.2 N m are lost: 0.388 m * 0.153 / 0.2.
    assert cart.base_position[0] == pytest.approx(0.297, rel=0.02)


@pytest.mark.parametrize("call", ["drive_at", "drive_to"])
def test_a_motor_has_its_speed_at_once_whatever_it_moves(sim, tmp_path, call):
    cart = load_cart(sim, tmp_path)
    cart.drive_at(0.0 * BOTH)
    sim.step()
    if call == "drive_at":
        cart.drive_at(5.0 * BOTH)
    else:
        cart.drive_to(100.0 * BOTH, max_speed=5.0)
    sim.step()
    # The robot is 13 times as heavy for the motor as the wheel alone.
    assert cart.joint_velocities == pytest.approx(5.0 * BOTH, abs=0.05)


def test_a_strong_motor_of_a_light_wheel_does_not_overshoot(sim, tmp_path):
    sim.set_gravity(0.0)
    cart = load_cart(sim, tmp_path, height=5.0)
    speeds = []
    for _ in range(5):
        cart.drive_at(25.0 * BOTH)
        sim.step()
        speeds.append(cart.joint_velocities)
    assert np.array(speeds) == pytest.approx(25.0, abs=0.3)  # 4 N m bring it there in three of four physics steps


def test_a_motor_gives_no_more_than_its_limit(sim, tmp_path):
    sim.set_gravity(0.0)
    cart = load_cart(sim, tmp_path, height=5.0)
    cart.drive_at(25.0 * BOTH, max_force=0.1)
    sim.step()
    assert cart.joint_torques == pytest.approx(0.1 * BOTH)
    # 0.1 N m / 0.002 kg m^2 * 0.02 s, and the body turns the other way: 2 * 0.1 / 0.07 * 0.02
    assert cart.joint_velocities == pytest.approx((1.0 + 0.057) * BOTH, abs=0.01)


def test_a_motor_that_is_switched_off_in_an_episode(sim, tmp_path):
    sim.set_gravity(0.0)
    cart = load_cart(sim, tmp_path, height=5.0)
    cart.drive_at(5.0 * BOTH)
    sim.step()
    cart.disable_motors(["left"])
    cart.drive_at(np.zeros(1), joints=["right"])
    sim.step()
    assert cart.joint_velocities == pytest.approx([5.0, 0.0], abs=0.3)


def test_a_reset_forgets_motors(sim, tmp_path):
    cart = load_cart(sim, tmp_path)
    rows = []
    for _ in range(2):
        sim.restore()
        cart.drive_at(5.0 * BOTH, max_force=0.5)
        sim.step()
        cart.drive_to(0.2 * BOTH, max_force=0.5)
        sim.step()
        rows.append(cart.joint_positions)
    assert rows[0].tolist() == rows[1].tolist()


def test_what_is_a_wheel(tmp_path):
    file = models.cart(tmp_path)
    assert read_urdf(file).wheels == {"left_wheel": 0.03, "right_wheel": 0.03}
    text = file.read_text()
    for other in (
        text.replace('type="continuous"', 'type="revolute"'),
        text.replace('<axis xyz="0 1 0"/>', '<axis xyz="1 0 0"/>'),
        text.replace('<origin rpy="1.5707963 0 0"/>', '<origin rpy="1.5707963 0 0" xyz="0.05 0 0"/>'),
        text.replace('<cylinder radius="0.1" length="0.03"/>', '<sphere radius="0.1"/>'),
    ):
        assert other != text
        file.write_text(other)
        assert read_urdf(file).wheels == {}


def test_the_frame_of_the_base_is_that_of_a_link(sim, tmp_path):
    cart = load_cart(sim, tmp_path)
    half = np.sqrt(0.5)
    cart.set_base((1.0, 2.0, 3.0), (half, 0.0, 0.0, half))  # on its side: its y axis points up
    # Its centre of mass is at z = -0.05 m of its frame, whose z axis points along -y.
    assert cart.link_position("body") == pytest.approx([1.0, 1.95, 3.0])
    assert cart.link_orientation("body") == pytest.approx([half, 0.0, 0.0, half])
    assert cart.mass_positions(["body"])[0] == pytest.approx([1.0, 2.0, 3.0])


def test_what_has_no_rows_says_so(tmp_path):
    with closing(MujocoSim(control_dt=0.02, substeps=4, worlds=2)) as sim:
        cart = load_cart(sim, tmp_path)
        with pytest.raises(
            UsageError, match=r"^mass_state has no rows, so a BatchTask of many worlds cannot use it; li"
        ):
            cart.mass_state("body")
