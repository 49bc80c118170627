"""Rough ground: heights of points on a grid."""

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError

Array = NDArray[np.float64]


def rough_heights(
    seed: int, *, size: tuple[float, float], cell: float, roughness: float, flat_radius: float = 0.0
) -> Array:
    """Return heights [m] of shape (along x, along y): uniform in [0, roughness] at points `cell` [m] apart.

    The ground covers `size` [m], centred at 0, 0. Within `flat_radius` [m] of the centre, where a robot starts, its
    height is 0; from there the roughness rises to its full value at twice that radius. Equal seeds give equal ground.
    Raises `TaskError` for a negative roughness, and for a size of less than two cells.
    """
    if roughness < 0:
        raise TaskError(f"terrain: roughness {roughness:g} m is negative")
    rows, columns = (round(length / cell) + 1 for length in size)
    if min(rows, columns) < 3:
        raise TaskError(f"terrain: {size[0]:g} m x {size[1]:g} m is less than two cells of {cell:g} m")
    heights = np.random.default_rng(seed).uniform(0.0, roughness, (rows, columns))
    x, y = ((np.arange(count) - (count - 1) / 2) * cell for count in heights.shape)
    if flat_radius > 0:
        heights *= np.clip((np.hypot(x[:, None], y[None, :]) - flat_radius) / flat_radius, 0.0, 1.0)
    return heights
