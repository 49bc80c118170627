"""How likely the readings of encoders are: a position with normal noise, which the encoder rounds to its step.

Rounding is no noise: where a joint rests or moves by less than a step, its error is the same from row to row, and a
least-squares fit takes it for motion. The likelihood of the interval that was rounded to a reading has no such error.
"""

import numpy as np

from rlctl_robot.identify.log import Array

LINEAR = 3.0  # standard deviations, beyond which an error counts linearly (Huber)
_FINEST = 1e-5  # [rad or m], of the noise of an encoder
_LEAST_NOISE = 0.1  # of a step: with less, the readings tell no more, and their likelihood has no derivative
_NARROW = 0.1  # width of an interval in standard deviations, that is as good as a point
_SEARCHES = 12  # each divides the range of the noise by 1.6
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_NEIGHBOURS, _OFF_GRID = 1.5, 0.2  # steps between neighbouring readings; distance of a reading from its multiple
_FEWEST = 8  # different readings, from which a step is told


def find_steps(positions: Array) -> Array:
    """Return the step to which each encoder rounds [rad or m], 0 where none is seen; (rows, joints) -> (joints,)."""
    return np.array([_find_step(np.unique(column)) for column in positions.T])


def _find_step(readings: Array) -> float:
    """Return the step whose multiples all readings are, but for the digits of the file."""
    gaps = np.diff(readings)
    gaps = gaps[gaps > 1e-6 * np.ptp(readings)]  # of the same reading, with another last bit
    if len(gaps) < _FEWEST:
        return 0.0
    near = gaps[gaps < _NEIGHBOURS * np.median(gaps)]
    multiples = np.concatenate([[0.0], np.cumsum(np.round(np.diff(readings) / near.mean()))])
    step, first = np.polyfit(multiples, readings, 1)
    is_on_grid = np.abs(readings - first - step * multiples).max() < _OFF_GRID * step
    return float(step) if is_on_grid else 0.0


class ReadingErrors:
    """Cost, slope and curvature of the errors of simulated positions: minus the logarithm of their likelihood.

    Errors have the shape (..., joints), `noise` is the standard deviation before rounding, shape (joints,).
    """

    def __init__(self, steps: Array) -> None:
        """`steps` are those of the encoders, shape (joints,); 0 for readings that are not rounded."""
        self._steps = steps

    def spread(self, noise: Array) -> Array:
        """Return the standard deviation of errors with noise and rounding."""
        spread: Array = np.sqrt(np.square(noise) + np.square(self._steps) / 12.0)
        return spread

    def cost(self, errors: Array, noise: Array) -> Array:
        """Return minus the logarithm of the likelihood of each error, relative to the width of the interval."""
        sizes, near = self._split(errors, noise)
        cost, slope, _ = self._evaluate(near, noise)
        result: Array = cost + slope * (sizes - near)
        return result

    def derive(self, errors: Array, noise: Array) -> tuple[Array, Array]:
        """Return the first and second derivative of the cost; for outliers the second is the first by the error."""
        sizes, near = self._split(errors, noise)
        _, slope, curvature = self._evaluate(near, noise)
        curvature = np.where(sizes > near, slope / np.maximum(sizes, _FINEST), curvature)
        return np.sign(errors) * slope, curvature

    def estimate_noise(self, errors: Array) -> Array:
        """Return the noise of each joint with which errors of shape (rows, joints) are most likely."""
        low = np.log(np.maximum(_FINEST, _LEAST_NOISE * self._steps))
        high = np.maximum(np.log(np.maximum(np.sqrt(np.square(errors).mean(axis=0)), _FINEST)), low) + 0.1
        inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
        costs = [self.cost(errors, np.exp(noise)).sum(axis=0) for noise in inner]
        for _ in range(_SEARCHES):
            is_left = costs[0] < costs[1]
            low, high = np.where(is_left, low, inner[0]), np.where(is_left, inner[1], high)
            new = np.where(is_left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
            cost = self.cost(errors, np.exp(new)).sum(axis=0)
            inner = [np.where(is_left, new, inner[1]), np.where(is_left, inner[0], new)]
            costs = [np.where(is_left, cost, costs[1]), np.where(is_left, costs[0], cost)]
        noise: Array = np.exp((low + high) / 2)
        return noise

    def _split(self, errors: Array, noise: Array) -> tuple[Array, Array]:
        sizes = np.abs(errors)
        return sizes, np.minimum(sizes, LINEAR * self.spread(noise))

    def _evaluate(self, sizes: Array, noise: Array) -> tuple[Array, Array, Array]:
        """Return the cost of errors above 0 with its first and second derivative.

        A reading's probability is P = F(b) - F(a) with the normal distribution F and the ends a, b of the interval
        that is rounded to it, in standard deviations from the simulated position.
        """
        from scipy.special import log_ndtr

        width = np.maximum(self._steps / noise, _NARROW)
        center = -sizes / noise
        begin, end = center - width / 2, center + width / 2
        log_begin, log_end = log_ndtr(begin), log_ndtr(end)
        log_probability = log_end + np.log(-np.expm1(log_begin - log_end))
        densities = [np.exp(-np.square(at) / 2 - log_probability) / np.sqrt(2 * np.pi) for at in (begin, end)]
        slope = densities[1] - densities[0]
        curvature = np.square(slope) + end * densities[1] - begin * densities[0]
        cost = (
            np.log(width * noise) - log_probability
        )  # relative to the width, which depends on the noise without a step
        return cost, slope / noise, np.maximum(curvature, 1e-9) / np.square(noise)
