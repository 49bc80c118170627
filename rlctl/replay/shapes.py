"""Draws a body from the shapes that PyBullet made of its file."""

from __future__ import annotations

from collections.abc import Callable

import rerun as rr

from rlctl.replay.scene import BodyMotion, Shape
from rlctl.replay.timelines import Timelines
from rlctl.task.bullet import pybullet

_MESHES = {".obj", ".stl", ".dae", ".glb", ".gltf"}


def draw_shapes(body: BodyMotion, timelines: Timelines, tell: Callable[[str], None]) -> None:
    """Draw every shape of every link, and move the links."""
    drawn = 0
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
            drawn += 1
    if drawn < len(body.shapes) or not drawn:
        tell(f"{body.file.name}: {drawn} of {len(body.shapes)} shapes of {body.name!r} could be drawn")


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
