"""Points on the collision shapes of a model in MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_POINTS = 200  # of a mesh or an ellipsoid


class Shapes:
    """The shapes of some geoms of a model, of which the lowest point is asked for in many poses."""

    def __init__(self, model: Any, geoms: Iterable[int]) -> None:
        self._clouds = [(int(model.geom_bodyid[geom]), *list_points(model, geom)) for geom in geoms]

    def find_lowest(self, data: Any) -> float:
        """Return the height of the lowest point [m]; infinite without shapes."""
        lowest = np.inf
        for body, points, radii in self._clouds:
            heights = points @ data.xmat[body].reshape(3, 3)[2] + data.xpos[body, 2] - radii
            lowest = min(lowest, float(heights.min()))
        return float(lowest)


def list_points(model: Any, geom: int) -> tuple[Array, Array]:
    """Return points on a shape in the frame of its link, shape (n, 3), and a radius around each [m], shape (n,)."""
    import mujoco

    kinds, kind, size = mujoco.mjtGeom, int(model.geom_type[geom]), model.geom_size[geom]
    radius = 0.0
    if kind == kinds.mjGEOM_SPHERE:
        points, radius = np.zeros((1, 3)), float(size[0])
    elif kind == kinds.mjGEOM_CAPSULE:
        points, radius = np.array([[0, 0, size[1]], [0, 0, -size[1]]]), float(size[0])
    elif kind == kinds.mjGEOM_MESH:
        points = _list_vertices(model, int(model.geom_dataid[geom]))
    elif kind == kinds.mjGEOM_CYLINDER:
        turns = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        circle = np.stack([size[0] * np.cos(turns), size[0] * np.sin(turns)], axis=1)
        points = np.concatenate([np.column_stack([circle, np.full(32, end)]) for end in (-size[1], size[1])])
    elif kind == kinds.mjGEOM_ELLIPSOID:
        points = _list_directions() * size
    else:
        points = size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.geom_quat[geom])
    return points @ frame.reshape(3, 3).T + model.geom_pos[geom], np.full(len(points), radius)


def _list_vertices(model: Any, mesh: int) -> Array:
    """Return vertices of a mesh: those that are farthest in some direction."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = np.asarray(model.mesh_vert[first : first + count], float)
    farthest: Array = vertices[np.unique((vertices @ _list_directions().T).argmax(axis=0))]
    return farthest


def _list_directions() -> Array:
    """Return directions that are spread evenly: a spiral around the sphere."""
    heights = 1 - (2 * np.arange(_POINTS) + 1) / _POINTS
    turns = np.arange(_POINTS) * np.pi * (3 - np.sqrt(5))
    around = np.sqrt(1 - heights**2)
    return np.stack([around * np.cos(turns), around * np.sin(turns), heights], axis=1)
