"""A scene as plain data for the page: shapes once per episode, then the poses of their links."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind, connect_grid
from rlctl.replaying.scene import BodyMotion, Scene
from rlctl.task.meshes import read_mesh
from rlctl.task.rotations import rotate

_MOST_TRIANGLES = 60_000  # of all meshes together: what is above is not drawn
_NOWHERE = -1e3  # [m], of bodies that do not exist now
_WORLD = -1  # the link of a shape in the world frame
_TERRAIN_COLOR = (0.45, 0.47, 0.45, 1.0)


def describe_shapes(scene: Scene) -> dict[str, Any]:
    """Return the shapes of a scene: `parts`, the height of the flat `ground` [m] or None, and names of `markers`.

    A part has a link, a kind (box, sphere, cylinder or mesh), a scale, its pose in the frame of the link and a colour.
    Links are numbered over all bodies, as in `list_poses`; -1 is the world.
    """
    parts: list[dict[str, Any]] = []
    first, left = 0, _MOST_TRIANGLES
    for body in scene.bodies:
        if body.terrain is not None:
            parts.append(_describe_terrain(body.terrain))
        elif body.ground_height is None:
            for shape in _list_shapes(body):
                part = _describe_shape(shape, first + body.links.index(shape.link))
                left -= len(part.get("triangles", ())) // 3
                parts += [part] if left >= 0 else []
        first += len(body.links)
    heights = [body.ground_height for body in scene.bodies if body.ground_height is not None]
    return {"parts": parts, "ground": min(heights, default=None), "markers": list(scene.markers)}


def _list_shapes(body: BodyMotion) -> Iterator[Shape]:
    for shape in body.shapes:
        if shape.kind is ShapeKind.CAPSULE:  # a cylinder with a ball at each end
            length, radius = shape.size[:2]
            yield dataclasses.replace(shape, kind=ShapeKind.CYLINDER)
            for end in (-length / 2, length / 2):
                offset = rotate(np.array(shape.orientation), np.array([0.0, 0.0, end]))
                position = tuple((np.array(shape.position) + offset).tolist())
                yield dataclasses.replace(shape, kind=ShapeKind.SPHERE, size=(radius,), position=position)
        elif shape.kind is not ShapeKind.OTHER:
            yield shape


def _describe_shape(shape: Shape, link: int) -> dict[str, Any]:
    part = {"link": link, "pose": [*shape.position, *shape.orientation], "color": list(shape.color)}
    if shape.kind is ShapeKind.MESH:
        return part | {"kind": "mesh", "scale": list(shape.size), **_describe_mesh(shape.mesh)}
    if shape.kind is ShapeKind.SPHERE:
        return part | {"kind": "sphere", "scale": list(shape.size) if len(shape.size) == 3 else [shape.size[0]] * 3}
    if shape.kind is ShapeKind.CYLINDER:
        length, radius = shape.size[:2]
        return part | {"kind": "cylinder", "scale": [radius, radius, length]}
    return part | {"kind": "box", "scale": list(shape.size)}


def _describe_terrain(points: Any) -> dict[str, Any]:
    rows, columns, _ = points.shape
    mesh = _describe_mesh(Mesh(points.reshape(-1, 3), connect_grid(rows, columns)))
    pose, scale = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], [1.0, 1.0, 1.0]
    return {"link": _WORLD, "pose": pose, "color": list(_TERRAIN_COLOR), "kind": "mesh", "scale": scale, **mesh}


def _describe_mesh(mesh: Path | Mesh | None) -> dict[str, Any]:
    points, triangles = np.zeros((0, 3)), np.zeros((0, 3), int)
    if isinstance(mesh, Mesh):
        points, triangles = mesh.vertices, mesh.triangles
    elif mesh is not None:
        with contextlib.suppress(ValueError):  # another format, which is not drawn
            points, triangles = read_mesh(mesh)
    return {"points": np.round(points, 5).ravel().tolist(), "triangles": np.asarray(triangles).ravel().tolist()}


def list_poses(scene: Scene) -> list[float]:
    """Return position [m] and quaternion (x, y, z, w) of every link at the last step, one after the other."""
    rows = [np.concatenate([body.positions[-1], body.orientations[-1]], axis=1) for body in scene.bodies if body.links]
    poses = np.nan_to_num(np.concatenate([*rows, np.zeros((0, 7))]), nan=_NOWHERE)
    return np.round(poses, 5).ravel().tolist()
