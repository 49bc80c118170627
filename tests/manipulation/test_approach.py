"""The way of a tool to a hole, by hand."""

import math

import numpy as np
import pytest

from rlctl_manipulation.approach import find_yaw_error, measure_way


def way(aside, height, depth=0.0):
    offset = np.array([0.6 * aside, 0.8 * aside, -height])
    return measure_way(offset, close=0.002, above=0.015, depth=depth)


def test_beside_the_hole_the_tip_should_be_over_the_rim():
    assert way(0.1, 0.015) == pytest.approx(0.1)
    assert way(0.1, 0.055) == pytest.approx(math.hypot(0.1, 0.04))
    assert way(0.003, 0.0) == pytest.approx(math.hypot(0.003, 0.005))  # 1 mm too far: 5 mm up


def test_over_the_hole_it_should_go_down():
    assert way(0.001, 0.02) == pytest.approx(math.hypot(0.001, 0.02))
    assert way(0.001, -0.02) == pytest.approx(0.001)  # in it
    assert way(0.0, 0.02, depth=0.005) == pytest.approx(0.025)
    assert way(0.0, -0.002, depth=0.005) == pytest.approx(0.003)
    assert way(0.0015, 0.0, depth=0.005) == pytest.approx(math.hypot(0.0015, 0.0025))  # half a millimetre to the rim
    assert way(0.0, -0.02, depth=0.005) == 0  # deeper is as good


@pytest.mark.parametrize(
    ("angle", "error"), [(0.1, 0.1), (0.1 + math.pi / 2, 0.1), (1.5, 1.5 - math.pi / 2), (-7, 2 * math.pi - 7)]
)
def test_a_quarter_turn_of_a_square_is_none(angle, error):
    assert find_yaw_error(angle) == pytest.approx(error)
