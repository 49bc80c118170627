"""How a square tool should come to a square hole: over the rim, down on its axis, turned like it."""

import math

import numpy as np


def measure_way(offset: np.ndarray, *, close: float, above: float, depth: float = 0.0) -> float:
    """Return how far a tip is from where it should be [m].

    `offset` is from the tip to the middle of the hole's mouth [m], shape (3,). On the hole's axis the tip should be
    `depth` below the mouth or deeper, at `close` from the axis level with it, and further out up to `above` over it:
    on the straight line it would drag over the rim.
    """
    aside, height = math.hypot(offset[0], offset[1]), -float(offset[2])
    wanted = min(max(5 * (aside - close), -depth), above)
    return math.hypot(aside, height - wanted if wanted > 0 else max(height - wanted, 0.0))


def find_yaw_error(angle: float) -> float:
    """Return the least turn [rad] that makes up for `angle` between two squares: a quarter turn is none."""
    quarter = math.pi / 2
    return (angle + quarter / 2) % quarter - quarter / 2
