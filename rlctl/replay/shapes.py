"""Draws a body from its shapes: those of an MJCF file, or what PyBullet made of another file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rlctl.replay.mjcf import Shape
from rlctl.replay.scene import BodyMotion
from rlctl.replay.timelines import Timelines
from rlctl.task.bullet import pybullet

_MESHES = {".obj", ".stl", ".dae", ".glb", ".gltf"}


def shape_centers(body: BodyMotion, link: int) -> NDArray[np.float64]:
    """Return where the shapes of a link are [m], world frame, shape (shapes, T + 1, 3)."""
    offsets = np.array([shape.position for shape in body.shapes if shape.link == body.links[link]]).reshape(-1, 3)
    vector, scalar = body.orientations[:, link, :3], body.orientations[:, link, 3:]
    # A vector r turned by the quaternion (v, w) is r + 2 w (v x r) + 2 v x (v x r).
    cross = np.cross(vector, offsets[:, None])
    turned = offsets[:, None] + 2 * scalar * cross + 2 * np.cross(vector, cross)
    return np.asarray(body.positions[:, link] + turned, np.float64)


def draw_shapes(body: BodyMotion, timelines: Timelines, tell: Callable[[str], None]) -> list[str]:
    """Draw every shape of every link, and move the links; return the entities of the shapes."""
    drawn = []
    for link, name in enumerate(body.links):
        shapes = [shape for shape in body.shapes if shape.link == name]
        if not shapes:
            continue
        entity = rr.new_entity_path(["world", body.name, name])
        columns = rr.Transform3D.columns(translation=body.positions[:, link], quaternion=body.orientations[:, link])
        timelines.send(entity, range(len(body.positions)), columns)
        for number, shape in enumerate(shapes):
            archetype = _archetype(shape)
            if archetype is None:
                continue
            place = f"{entity}/shape_{number}"
            timelines.stream.log(place, archetype, static=True)
            timelines.stream.log(place, _pose(shape), static=True)
            drawn.append(place)
    if len(drawn) < len(body.shapes) or not drawn:
        tell(f"{body.file.name}: {len(drawn)} of {len(body.shapes)} shapes of {body.name!r} could be drawn")
    return drawn


def _pose(shape: Shape) -> rr.Transform3D:
    scale = shape.size if shape.kind == pybullet.GEOM_MESH else None
    return rr.Transform3D(translation=shape.position, quaternion=rr.Quaternion(xyzw=shape.orientation), scale=scale)


def _archetype(shape: Shape) -> rr.AsComponents | None:
    color = [round(255 * channel) for channel in shape.color]
    solid = rr.components.FillMode.Solid
    if shape.kind == pybullet.GEOM_BOX:
        return rr.Boxes3D(half_sizes=[[extent / 2 for extent in shape.size]], colors=[color], fill_mode=solid)
    if shape.kind == pybullet.GEOM_SPHERE:
        return rr.Ellipsoids3D(half_sizes=[[shape.size[0]] * 3], colors=[color], fill_mode=solid)
    if shape.kind == pybullet.GEOM_CYLINDER:
        return rr.Cylinders3D(lengths=shape.size[0], radii=shape.size[1], colors=[color], fill_mode=solid)
    if shape.kind == pybullet.GEOM_CAPSULE:
        length, radius = shape.size[:2]
        # Rerun's capsules start at the centre of one end; PyBullet's are centred.
        half = [[0.0, 0.0, -length / 2]]
        return rr.Capsules3D(lengths=length, radii=radius, translations=half, colors=[color], fill_mode=solid)
    if shape.mesh and shape.mesh.is_file() and shape.mesh.suffix.lower() in _MESHES:
        return rr.Asset3D(path=shape.mesh, albedo_factor=color)
    return None
