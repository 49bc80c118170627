"""Which values a log tells, and which it cannot tell from each other."""

from collections.abc import Sequence

import numpy as np

from rlctl_robot.identify.log import Array

CONFIDENCE = 1.96  # standard deviations of a 95 % interval
WIDEST = 0.3  # a value is unknown if its interval is wider than this fraction of it, to each side
_MIN_COMPONENT = 0.3  # smallest component of a value in a direction, for its name to be listed


def explain_unknown(names: Sequence[str], index: int, information: Array) -> str:
    """Name the values that can change together without an effect on the log."""
    sizes, directions = np.linalg.eigh(information)
    shares = np.abs(directions[index]) / np.sqrt(np.maximum(sizes, 1e-12 * sizes[-1]))
    direction = directions[:, int(shares.argmax())]
    large = np.flatnonzero(np.abs(direction) >= _MIN_COMPONENT).tolist()
    others = [names[other] for other in large if other != index] or ["the others"]
    return f"this log cannot tell {names[index]} from {' and '.join(others)}"


def measure_noise(positions: Array) -> Array:
    """Return the noise of positions, shape (rows, joints) -> (joints,)."""
    # Third differences remove the motion; they have 1 + 9 + 9 + 1 times the variance of the noise.
    noise: Array = np.sqrt(np.square(np.diff(positions, 3, axis=0)).mean(axis=0) / 20)
    return noise
