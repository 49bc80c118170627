"""The likelihood of readings of encoders that round: its numbers by hand, the step, the noise, and no bias at rest."""

import numpy as np
import pytest
from scipy.stats import norm

from rlctl_robot.identify.readings import ReadingErrors, find_steps

STEP = 0.0015  # [rad]


def test_cost_is_the_probability_of_the_interval_that_is_rounded():
    readings = ReadingErrors(np.array([STEP]))
    # The simulated position is 0.0010 above the reading: the reading's interval is from -0.00175 to -0.00025 of it.
    probability = norm.cdf(-0.00025 / 0.0005) - norm.cdf(-0.00175 / 0.0005)
    cost = readings.cost(np.array([0.0010]), np.array([0.0005]))
    assert cost == pytest.approx(-np.log(probability / STEP))


@pytest.mark.parametrize(("step", "noise"), [(STEP, 0.0005), (STEP, 0.00015), (0.0, 0.0005), (STEP, 0.02)])
def test_slope_and_curvature_are_derivatives_of_the_cost(step, noise):
    readings, noises = ReadingErrors(np.array([step])), np.array([noise])
    errors = np.linspace(-2.5, 2.5, 10)[:, None] * readings.spread(noises)
    slopes, curvatures = readings.derive(errors, noises)
    small = 1e-4 * noise
    numeric = (readings.cost(errors + small, noises) - readings.cost(errors - small, noises)) / (2 * small)
    assert slopes == pytest.approx(numeric, rel=1e-4)
    above, below = (readings.derive(errors + sign * small, noises)[0] for sign in (1, -1))
    assert curvatures == pytest.approx((above - below) / (2 * small), rel=1e-3)


def test_outliers_count_linearly():
    readings, noise = ReadingErrors(np.array([0.0])), np.array([0.001])
    slopes, curvatures = readings.derive(np.array([[0.003], [0.1], [-0.1]]), noise)
    assert slopes[1] == pytest.approx(slopes[0])
    assert slopes[2] == -slopes[1]
    assert curvatures[1] == pytest.approx(slopes[1] / 0.1)


@pytest.mark.parametrize("digits", [4, 8])
def test_steps_of_encoders_are_found_and_none_where_there_is_none(digits):
    rng = np.random.default_rng(0)
    positions = rng.uniform(-1, 1, (2000, 2)) * [1.0, 0.02]
    rounded = np.round(np.round(positions / STEP) * STEP + 0.3, digits)
    assert find_steps(rounded) == pytest.approx([STEP, STEP], rel=1e-3)
    assert find_steps(positions).tolist() == [0.0, 0.0]
    assert find_steps(np.round(positions[:20] / 0.5) * 0.5).tolist() == [0.0, 0.0]  # too few different readings


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_noise_before_rounding_is_estimated(share):
    rng = np.random.default_rng(1)
    true = rng.uniform(0, 1, (4000, 1))
    read = np.round((true + share * STEP * rng.normal(size=true.shape)) / STEP) * STEP
    found = ReadingErrors(np.array([STEP])).estimate_noise(true - read)
    assert found == pytest.approx(share * STEP, rel=0.05)


def test_a_motion_below_one_step_has_its_true_size():
    rng = np.random.default_rng(2)
    wave = 0.2 * STEP * np.sin(np.linspace(0, 200, 20_000))  # around a multiple of the step
    read = (np.round((wave + 0.3 * STEP * rng.normal(size=wave.shape)) / STEP) * STEP)[:, None]
    readings, noise = ReadingErrors(np.array([STEP])), np.array([0.3 * STEP])
    # The encoder's mean reading moves by 0.7 of the wave: least squares finds that, the likelihood the wave.
    assert float(read[:, 0] @ wave / (wave @ wave)) == pytest.approx(0.7, abs=0.05)
    factor = 0.5
    for _ in range(20):
        slopes, curvatures = readings.derive(factor * wave[:, None] - read, noise)
        factor -= float(slopes[:, 0] @ wave / (curvatures[:, 0] @ np.square(wave)))
    assert factor == pytest.approx(1.0, abs=0.05)
