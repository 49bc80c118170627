"""Points on the surfaces of a robot's links: of its meshes as the files have them, not of their hulls."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.tasks.shapes import Array

_POINTS = 3000  # of a link
_RING = 24  # points around a cylinder
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_SIDES = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
"""Corners of a box's sides, in order around each."""


class Surfaces:
    """The surfaces of the links of a model file, as points in the frames of the links.

    Visual shapes are preferred: collision shapes are often simpler than the part that they stand for. All is computed
    from the file as `read_model_file` reads it, with detailed meshes.
    """

    def __init__(self, path: Path) -> None:
        from rlctl.task.mujoco.files import read_model_file

        self._model: Any = read_model_file(path, fixed=True, hulls=False).spec.compile()
        self._points: dict[str, Array] = {}

    def list_points(self, link: str) -> Array:
        """Return points spread evenly over a link's surface [m], shape (n, 3); n is 0 for a link without shapes."""
        if link not in self._points:
            self._points[link] = self._sample(link)
        return self._points[link]

    def _sample(self, link: str) -> Array:
        triangles = [self._list_triangles(geom) for geom in self._choose_geoms(link)]
        if not triangles:
            return np.zeros((0, 3))
        corners = np.concatenate(triangles)
        sides = corners[:, 1:] - corners[:, :1]
        areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        if not areas.sum() > 0:
            return corners.reshape(-1, 3)
        rng = np.random.default_rng(0)
        chosen = rng.choice(len(areas), _POINTS, p=areas / areas.sum())
        along = np.sort(rng.uniform(size=(_POINTS, 2)), axis=1)
        weights = np.stack([along[:, 0], along[:, 1] - along[:, 0], 1 - along[:, 1]], axis=1)
        points: Array = np.einsum("pc,pcx->px", weights, corners[chosen])
        return points

    def _choose_geoms(self, link: str) -> list[int]:
        """Return a link's visual shapes, or if it has none its collision shapes of the lowest group."""
        model, number = self._model, self._model.body(link).id
        planes = [geom for geom in range(model.ngeom) if model.geom_type[geom] == 0]
        own = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == number and geom not in planes]
        seen = [geom for geom in own if not (model.geom_contype[geom] or model.geom_conaffinity[geom])]
        chosen = seen or own
        lowest = min((int(model.geom_group[geom]) for geom in chosen), default=0)
        return [geom for geom in chosen if model.geom_group[geom] == lowest]

    def _list_triangles(self, geom: int) -> Array:
        """Return the triangles of a shape in the frame of its link, shape (n, 3, 3)."""
        import mujoco

        model, kinds = self._model, mujoco.mjtGeom
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        if kind == kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            vertices = np.asarray(model.mesh_vert[first : first + count], float)
            start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            triangles = vertices[model.mesh_face[start : start + faces]]
        elif kind == kinds.mjGEOM_BOX:
            triangles = _split_quads((_CORNERS * size)[_SIDES])
        elif kind == kinds.mjGEOM_CYLINDER:
            triangles = _turn([(0.0, -size[1]), (size[0], -size[1]), (size[0], size[1]), (0.0, size[1])])
        else:
            triangles = _turn(_list_profile(kind == kinds.mjGEOM_CAPSULE, size))
            if kind == kinds.mjGEOM_ELLIPSOID:
                triangles = triangles * (size / size[0])
        frame = np.zeros(9)
        mujoco.mju_quat2Mat(frame, model.geom_quat[geom])
        moved: Array = triangles @ frame.reshape(3, 3).T + model.geom_pos[geom]
        return moved


def _list_profile(is_capsule: bool, size: Array) -> list[tuple[float, float]]:
    """Return the half circle of a sphere, drawn apart by the length of a capsule: radius and height of its points."""
    half = float(size[1]) if is_capsule else 0.0
    angles = np.linspace(-np.pi / 2, np.pi / 2, 12)
    radius = float(size[0])
    return [(radius * np.cos(angle), radius * np.sin(angle) + np.copysign(half, angle)) for angle in angles]


def _turn(profile: list[tuple[float, float]]) -> Array:
    """Return the triangles of a profile that is turned about z."""
    turns = np.linspace(0, 2 * np.pi, _RING + 1)
    rings = [
        np.stack([radius * np.cos(turns), radius * np.sin(turns), np.full(_RING + 1, height)], axis=1)
        for radius, height in profile
    ]
    quads = [np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1) for low, high in itertools.pairwise(rings)]
    return _split_quads(np.concatenate(quads))


def _split_quads(quads: Array) -> Array:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
