"""Reward terms, with their arithmetic by hand."""

import math

import numpy as np
import pytest

from rlctl.errors import TaskError
from rlctl.task import rewards


def test_distance():
    # (3, 4, 12) m apart: sqrt(9 + 16 + 144) = 13
    assert rewards.distance(np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0, 15.0])) == 13.0


def test_closeness():
    # 0.1 m with a scale of 0.05 m: exp(-(0.1 / 0.05)^2) = exp(-4)
    assert rewards.closeness(0.1, 0.05) == pytest.approx(math.exp(-4))
    assert rewards.closeness(0.0, 0.05) == 1.0


def test_arrival():
    assert rewards.arrival(0.049, 0.05) == 1.0
    assert rewards.arrival(0.05, 0.05) == 0.0  # at the tolerance is not within it


def test_squared():
    # of joint velocities: (1 + 4 + 9 + 0) / 4 = 3.5 (rad/s)^2
    assert rewards.squared(np.array([1.0, -2.0, 3.0, 0.0])) == 3.5


def test_change():
    # differences 0.5 and -1.0: (0.25 + 1.0) / 2 = 0.625
    assert rewards.change(np.array([0.5, -0.5]), np.array([0.0, 0.5])) == 0.625
    assert rewards.change(np.array([0.5, -0.5]), np.array([0.5, -0.5])) == 0.0


def test_power():
    # |2 N m x 3 rad/s| + |-1 x 4| + |5 x 0| = 6 + 4 + 0 = 10 W: braking costs as well
    assert rewards.power(np.array([2.0, -1.0, 5.0]), np.array([3.0, 4.0, 0.0])) == 10.0


def test_forward_velocity():
    # (1, 2, 3) m/s along (0, 3, 4) / 5: (2 * 3 + 3 * 4) / 5 = 3.6 m/s
    assert rewards.forward_velocity(np.array([1.0, 2.0, 3.0]), np.array([0.0, 3.0, 4.0])) == pytest.approx(3.6)
    # backwards is negative
    assert rewards.forward_velocity(np.array([-2.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])) == -2.0


def test_forward_while_alive():
    velocity, heading = np.array([1.5, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    assert rewards.forward_while_alive(velocity, heading, alive=True) == 1.5
    assert rewards.forward_while_alive(velocity, heading, alive=False) == 0.0


def test_alive():
    assert rewards.alive(terminated=False) == 1.0
    assert rewards.alive(terminated=True) == 0.0


def quaternion(axis, angle):
    return np.append(np.sin(angle / 2) * np.eye(3)[axis], np.cos(angle / 2))


def test_posture():
    # 0.3 rad of roll alone, then 0.4 of pitch alone: 0.09, 0.16 rad^2
    assert rewards.posture(quaternion(0, 0.3)) == pytest.approx(0.09)
    assert rewards.posture(quaternion(1, -0.4)) == pytest.approx(0.16)
    # heading is no matter of posture
    assert rewards.posture(quaternion(2, 2.0)) == 0.0
    # on its nose: pitch 90 degrees, (pi / 2)^2, even where rounding makes the sine larger than 1
    assert rewards.posture(np.array([0.0, 0.70710679, 0.0, 0.70710679])) == pytest.approx((math.pi / 2) ** 2)


@pytest.mark.pybullet
def test_posture_agrees_with_pybullet():
    from rlctl.task.pybullet.library import pybullet

    for roll, pitch, yaw in np.random.default_rng(0).uniform(-1.5, 1.5, (20, 3)):
        orientation = np.array(pybullet.getQuaternionFromEuler([roll, pitch, yaw]))
        assert rewards.posture(orientation) == pytest.approx(roll**2 + pitch**2)


def test_fallen():
    assert rewards.fallen(0.19, 0.2) == 1.0
    assert rewards.fallen(0.2, 0.2) == 0.0


def test_speed():
    # sqrt(4 + 9 + 36) = 7 rad/s
    assert rewards.speed(np.array([2.0, 3.0, -6.0])) == 7.0


def test_grasp():
    # at the scale: 0.5 / e; holding adds 0.5; holding at the centre is 1
    assert rewards.grasp(0.1, 0.1, held=False) == pytest.approx(0.5 / math.e)
    assert rewards.grasp(0.1, 0.1, held=True) == pytest.approx(0.5 / math.e + 0.5)
    assert rewards.grasp(0.0, 0.1, held=True) == 1.0


def test_time_spent():
    # 60 steps of 1/60 s cost what 30 steps of 1/30 s do
    assert sum(rewards.time_spent(1 / 60) for _ in range(60)) == pytest.approx(1.0)
    assert sum(rewards.time_spent(1 / 30) for _ in range(30)) == pytest.approx(1.0)


def test_near_limits():
    low, high = np.array([-1.0, -1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0, -1.0])
    # margin 0.2 rad: 0.15 before the limit 1 - 0.15 / 0.2 = 0.25; at it 1; in the middle 0; without limits 0
    positions = np.array([0.85, -1.0, 0.0, 5.0])
    assert rewards.near_limits(positions, low, high, 0.2) == pytest.approx((0.25 + 1 + 0 + 0) / 4)
    # 0.1 rad beyond one: 1 + 0.1 / 0.2 = 1.5, a quarter of it
    assert rewards.near_limits(np.array([0.0, 1.1, 0.0, 0.0]), low, high, 0.2) == pytest.approx(1.5 / 4)


def test_excess_force():
    # (120 - 100) + (300 - 100) + 0 = 220 N
    assert rewards.excess_force(np.array([120.0, 300.0, 80.0]), 100.0) == 220.0
    assert rewards.excess_force(np.array([]), 100.0) == 0.0


def test_penetration():
    assert rewards.penetration(np.array([0.01, -0.002, -0.005])) == 0.005
    assert rewards.penetration(np.array([0.01])) == 0.0
    assert rewards.penetration(np.array([])) == 0.0


@pytest.mark.parametrize(
    ("falloff", "half", "at", "double"),
    [
        # v = 0.1 at the margin; d = 0.5 and 2
        ("gaussian", 0.1**0.25, 0.1, 0.1**4),
        ("linear", 1 - 0.9 * 0.5, 0.1, 0.0),
        ("long_tail", 1 / (1 + 9 * 0.25), 0.1, 1 / (1 + 9 * 4)),
    ],
)
def test_tolerance(falloff, half, at, double):
    # bounds 1 to 2, margin 0.4: 0.5 margins outside are 0.8 and 2.2
    for x, expected in [(1.0, 1), (1.5, 1), (2.0, 1), (0.8, half), (2.2, half), (2.4, at), (0.2, double)]:
        assert rewards.tolerance(x, (1.0, 2.0), 0.4, falloff) == pytest.approx(expected)


def test_tolerance_with_another_value_at_the_margin():
    # 0.5^(0.5^2) = 0.8409
    assert rewards.tolerance(0.1, margin=0.2, at_margin=0.5) == pytest.approx(0.8408964)


def test_tolerance_without_a_margin_is_a_step():
    assert rewards.tolerance(1.0, (0.0, 1.0)) == 1.0
    assert rewards.tolerance(1.0001, (0.0, 1.0)) == 0.0


def test_tolerance_with_one_bound():
    # standing: as high as you like, half a margin too low
    assert rewards.tolerance(9.0, (1.4, math.inf), 0.7) == 1.0
    assert rewards.tolerance(1.05, (1.4, math.inf), 0.7) == pytest.approx(0.1**0.25)


def test_tolerance_of_an_array():
    values = rewards.tolerance(np.array([[0.0, 0.5], [1.0, 2.0]]), margin=1.0, falloff="linear")
    assert values.shape == (2, 2)
    np.testing.assert_allclose(values, [[1.0, 0.55], [0.1, 0.0]])


def test_tolerance_keeps_what_is_not_a_number():
    for falloff in ("gaussian", "linear", "long_tail"):
        assert math.isnan(rewards.tolerance(math.nan, (0.0, 1.0), 1.0, falloff))
    assert math.isnan(rewards.tolerance(math.nan, (0.0, 1.0)))
    assert math.isnan(rewards.penetration(np.array([0.1, math.nan])))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bounds": (2.0, 1.0)}, "tolerance: bounds (2, 1) are reversed"),
        ({"margin": -0.1}, "tolerance: margin -0.1 is negative"),
        ({"at_margin": 1.0}, "tolerance: at_margin 1 is not between 0 and 1"),
        ({"falloff": "cubic"}, "tolerance: no falloff 'cubic'. There are: gaussian, linear, long_tail"),
    ],
)
def test_tolerance_that_makes_no_sense(arguments, message):
    with pytest.raises(TaskError) as caught:
        rewards.tolerance(0.0, **arguments)
    assert str(caught.value) == message


STEEP = np.array([0.0, 0.70710679, 0.0, 0.70710679])
VELOCITIES = np.array([[1.0, 2.0, 3.0], [-2.0, 0.0, 0.0]])  # [m/s]
UPRIGHT = np.array([True, False])
AHEAD = np.array([2.0, 0.0, 0.0])
OF_WORLDS = {  # arguments of two worlds, arguments of both, values
    # (3, 4, 12) and (0, 0, 2) m apart: 13 and 2
    "distance": ([[[4.0, 6.0, 15.0], [1.0, 2.0, 5.0]]], {"b": np.array([1.0, 2.0, 3.0])}, [13.0, 2.0]),
    # exp(-(0.1 / 0.05)^2) and exp(0)
    "closeness": ([[0.1, 0.0]], {"scale": 0.05}, [math.exp(-4), 1.0]),
    "arrival": ([[0.049, 0.05]], {"tolerance": 0.05}, [1.0, 0.0]),
    # (1 + 4 + 9 + 0) / 4 and (4 + 0 + 0 + 0) / 4
    "squared": ([[[1.0, -2.0, 3.0, 0.0], [0.0, 2.0, 0.0, 0.0]]], {}, [3.5, 1.0]),
    # (0.25 + 1.0) / 2 and no change
    "change": ([[[0.5, -0.5], [1.0, 2.0]], [[0.0, 0.5], [1.0, 2.0]]], {}, [0.625, 0.0]),
    # 6 + 4 + 0 and |1 x -2| W
    "power": ([[[2.0, -1.0, 5.0], [1.0, 0.0, 0.0]], [[3.0, 4.0, 0.0], [-2.0, 1.0, 1.0]]], {}, [10.0, 2.0]),
    # (2 * 3 + 3 * 4) / 5 along (0, 3, 4), and -2 along (1, 0, 0)
    "forward_velocity": ([VELOCITIES, [[0.0, 3.0, 4.0], [1.0, 0.0, 0.0]]], {}, [3.6, -2.0]),
    "forward_while_alive": ([VELOCITIES], {"heading": AHEAD, "alive": UPRIGHT}, [1.0, 0.0]),
    "alive": ([UPRIGHT], {}, [0.0, 1.0]),
    # 0.3 rad of roll, and on its nose: (pi / 2)^2
    "posture": ([[quaternion(0, 0.3), STEEP]], {}, [0.09, (math.pi / 2) ** 2]),
    "fallen": ([[0.19, 0.2]], {"lowest": 0.2}, [1.0, 0.0]),
    # sqrt(4 + 9 + 36) = 7 rad/s
    "speed": ([[[2.0, 3.0, -6.0], [0.0, 0.0, 0.5]]], {}, [7.0, 0.5]),
    # at the scale 0.5 / e, with 0.5 while it is held
    "grasp": ([[0.1, 0.1]], {"scale": 0.1, "held": UPRIGHT}, [0.5 / math.e + 0.5, 0.5 / math.e]),
    # (0.25 + 1) / 2, and in the middle
    "near_limits": (
        [[[0.85, -1.0], [0.0, 0.0]]],
        {"low": -np.ones(2), "high": np.ones(2), "margin": 0.2},
        [0.625, 0.0],
    ),
    # half a margin outside 0.1^(0.5^2), and inside
    "tolerance": ([[0.8, 1.5]], {"bounds": (1.0, 2.0), "margin": 0.4}, [0.1**0.25, 1.0]),
}


@pytest.mark.parametrize("term", OF_WORLDS)
def test_a_value_per_world(term):
    of_worlds, of_both, expected = OF_WORLDS[term]
    function, arrays = getattr(rewards, term), [np.array(values) for values in of_worlds]
    values = function(*arrays, **of_both)
    assert values.shape == (2,)
    assert values.dtype == np.float64
    np.testing.assert_allclose(values, expected, atol=1e-12)


def test_one_heading_for_all_worlds():
    np.testing.assert_array_equal(rewards.forward_velocity(VELOCITIES, AHEAD), [1.0, -2.0])


@pytest.mark.parametrize("term", ["speed", "posture", "squared", "power", "near_limits", "forward_velocity"])
def test_a_world_has_the_same_bits_alone(term):
    rows, both = np.random.default_rng(0).normal(size=(2, 65, 4)), OF_WORLDS[term][1]
    both = {name: np.resize(value, 4) if isinstance(value, np.ndarray) else value for name, value in both.items()}
    arrays = rows[: len(OF_WORLDS[term][0])]
    every = getattr(rewards, term)(*arrays, **both)
    for world in range(65):
        alone = getattr(rewards, term)(*(values[[world]] for values in arrays), **both)
        assert alone.tolist() == [every[world]]


@pytest.mark.parametrize("falloff", ["gaussian", "linear", "long_tail"])
def test_tolerance_of_many_is_that_of_each(falloff):
    values = np.array([-1e200, -1.0, 0.0, 0.3, 1.0, 1.05, 1.2, 2.0, math.inf, math.nan])
    many = rewards.tolerance(values, (0.0, 1.0), 0.1, falloff)
    each = [rewards.tolerance(value, (0.0, 1.0), 0.1, falloff) for value in values.tolist()]
    np.testing.assert_allclose(many, each, rtol=1e-14)
    step = rewards.tolerance(values, (0.0, 1.0))
    np.testing.assert_array_equal(step, [0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, math.nan])
