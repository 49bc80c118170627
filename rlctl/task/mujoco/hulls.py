"""Convex hulls of collision meshes.

MuJoCo collides with the hull of a mesh. The rest of a detailed mesh changes nothing, and takes most of a model's
memory.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.meshes import read_mesh, write_msh
from rlctl.task.mujoco.world import import_mujoco

_LARGE = 20_000  # [bytes], of a mesh file whose hull saves memory
_SUFFIXES = (".stl", ".obj", ".dae")


def use_hulls(spec: Any, files: Mapping[str, Path]) -> None:
    """Replace the large meshes with which geoms collide by their hulls; `files` has the file of a mesh by its name.

    Meshes that are also seen are kept for that. The inertia of no body changes.
    """
    mujoco = import_mujoco()
    kind, convex = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    meshes = {mesh.name: mesh for mesh in spec.meshes}
    hulls: dict[str, str] = {}  # names by that of the mesh
    for geom in [geom for geom in spec.geoms if geom.type == kind and (geom.contype or geom.conaffinity)]:
        mesh, name = meshes[geom.meshname], geom.meshname
        if not geom.parent.explicitinertial and mesh.inertia != convex:
            continue  # its inertia is computed from the mesh
        if name not in hulls and (points := _read_hull(files.get(name))) is not None:
            hulls[name] = f"{name} hull"
            # MuJoCo keeps what it computed of a file, also of one in memory, but not of points.
            file = f"{hashlib.sha256(points.tobytes()).hexdigest()[:32]}.msh"
            spec.assets[file] = write_msh(points, np.zeros((0, 3), int))
            spec.add_mesh(
                name=hulls[name],
                file=file,
                inertia=convex,
                scale=mesh.scale,
                refpos=mesh.refpos,
                refquat=mesh.refquat,
                maxhullvert=mesh.maxhullvert,
            )
        geom.meshname = hulls.get(name, name)
    delete_unused_meshes(spec, hulls)


def delete_unused_meshes(spec: Any, names: Any) -> None:
    """Delete those of some meshes that no geom has."""
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [mesh for mesh in spec.meshes if mesh.name in names and mesh.name not in used]:
        spec.delete(mesh)


def _read_hull(file: Path | None) -> NDArray[np.float64] | None:
    """Return the points of a file's hull; None for a small file, or one that cannot be read here."""
    try:
        if file is None or file.suffix.lower() not in _SUFFIXES or (about := file.stat()).st_size < _LARGE:
            return None
        return _compute_hull(file, about.st_mtime_ns)
    except (OSError, ValueError):  # MuJoCo reads the file itself, and says what is wrong with it
        return None


@functools.lru_cache(maxsize=256)  # every environment of a worker needs the same
def _compute_hull(file: Path, changed_ns: int) -> NDArray[np.float64]:
    """Return the points of a mesh's hull, shape (points, 3); raises `ValueError` for a file that has none."""
    mujoco, spec = import_mujoco(), import_mujoco().MjSpec()
    points = read_mesh(file)[0]
    spec.add_mesh(name="mesh", uservert=points.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    model, turn = spec.compile(), np.zeros(9)
    # The graph has the number of points, that of faces, an address and then the number of each point.
    count = int(model.mesh_graph[0])
    numbers = model.mesh_graph[2 + count : 2 + 2 * count]
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    # MuJoCo moves a mesh to its centre and its axes of inertia.
    hull: NDArray[np.float64] = model.mesh_vert[numbers].astype(float) @ turn.reshape(3, 3).T + model.mesh_pos[0]
    return hull
