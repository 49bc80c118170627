"""Elements of the observation that are a value of the engine times a factor, exactly or with noise."""

import numpy as np
import pytest

from rlctl.checking.engine_values import EngineValue, EngineValues, find_scaled

TURNING = EngineValue("angular velocity of arm", is_angle=True, is_speed=True)
MOVING = EngineValue("velocity of arm", is_angle=False, is_speed=True)


def scale(columns, rows):
    return find_scaled(EngineValues([TURNING, MOVING], rows), np.column_stack(columns), [len(rows) // 2] * 2)


def test_factor_of_an_exact_element_is_that_of_its_unit():
    rows = np.random.default_rng(0).normal(size=(200, 2))
    (found,) = scale([np.rad2deg(rows[:, 0]) + 5.0], rows)
    assert found.value is TURNING
    assert found.is_exact
    assert found.factor == pytest.approx(57.29578)
    assert found.has_factor(180 / np.pi)
    assert not found.has_factor(57.0)


def test_factor_of_an_element_with_noise_is_known_to_some_per_cent():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(400, 2))
    (found,) = scale([1000.0 * rows[:, 1] + rng.normal(0.0, 100.0, 400)], rows)
    assert found.value is MOVING
    assert not found.is_exact
    assert found.has_factor(1000.0)


def test_what_is_left_of_another_quantity_is_no_noise():
    time = np.linspace(0.0, 20.0, 400)
    rows = np.column_stack([np.sin(time), np.cos(3 * time)])
    assert scale([100.0 * np.sin(time) + 25.0 * np.sin(2 * time)], rows) == []
