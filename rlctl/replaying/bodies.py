"""Draws a world in a recording: the shapes of bodies, markers, paths."""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rlctl.replaying.curves import Timelines
from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind
from rlctl.replaying.scene import BodyMotion, Scene, Warn

_MARKER_COLORS = [(40, 200, 90), (70, 150, 255), (240, 120, 200), (250, 180, 40)]
_HALO_RADIUS = 0.09  # [m]
_PATH_COLOR = (255, 80, 180)
_GROUND_COLOR = (70, 74, 82)
_MESHES = {".obj", ".stl", ".dae", ".glb", ".gltf"}


def draw_scene(scene: Scene, timelines: Timelines, warn: Warn) -> tuple[str, BodyMotion] | None:
    """Draw everything under `world/`; `warn` receives messages about what could not be drawn.

    Returns what the camera follows: the first robot with a trunk that was drawn, and the entity of the trunk.
    """
    trunks: list[tuple[str, BodyMotion]] = []
    timelines.stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for body in scene.bodies:
        if body.ground_height is not None:
            _draw_ground(body, scene, timelines)
        elif body.terrain is not None:
            _draw_terrain(body.name, body.terrain, timelines)
        else:
            drawn = draw_shapes(body, timelines, warn)
            if body.trunk is not None:
                trunk = rr.new_entity_path(["world", body.name, body.links[body.trunk]]) + "/"
                trunks += [(entity, body) for entity in drawn if entity.startswith(trunk)]
        _draw_path(body, timelines)
    for number, (name, positions) in enumerate(scene.markers.items()):
        _draw_marker(name, positions, _MARKER_COLORS[number % len(_MARKER_COLORS)], timelines)
    return trunks[0] if trunks else None


def _draw_marker(name: str, positions: NDArray[np.float64], color: tuple[int, int, int], timelines: Timelines) -> None:
    """Draw a labelled point, and a halo that stays visible when a gripper covers the point."""
    entity, steps = rr.new_entity_path(["world", "markers", name]), range(len(positions))
    stream = timelines.stream
    # Positions are not static: static data would hide the moving ones.
    stream.log(entity, rr.Points3D.from_fields(radii=0.03, colors=color, labels=name, show_labels=True), static=True)
    timelines.send(entity, steps, rr.Points3D.columns(positions=positions))
    mode = rr.components.FillMode.MajorWireframe
    halo = rr.Ellipsoids3D.from_fields(half_sizes=[[_HALO_RADIUS] * 3], colors=color, line_radii=0.003, fill_mode=mode)
    stream.log(f"{entity}/halo", halo, static=True)
    timelines.send(f"{entity}/halo", steps, rr.Ellipsoids3D.columns(centers=positions))


def _draw_ground(body: BodyMotion, scene: Scene, timelines: Timelines) -> None:
    low, high = bounds(scene)
    center, half = (low + high)[:2] / 2, max(2.0, float((high - low)[:2].max()))
    thickness = 0.01
    box = rr.Boxes3D(
        centers=[[*center, (body.ground_height or 0.0) - thickness]],
        half_sizes=[[half, half, thickness / 2]],
        colors=[_GROUND_COLOR],
        fill_mode=rr.components.FillMode.Solid,
    )
    timelines.stream.log(rr.new_entity_path(["world", body.name]), box, static=True)


def _draw_terrain(name: str, points: NDArray[np.float64], timelines: Timelines) -> None:
    rows, columns, _ = points.shape
    corner = np.arange(rows * columns).reshape(rows, columns)[:-1, :-1].ravel()
    right, above = corner + columns, corner + 1
    triangles = np.concatenate([np.stack([corner, right, right + 1], 1), np.stack([corner, right + 1, above], 1)])
    low, height = points[..., 2].min(), max(float(np.ptp(points[..., 2])), 1e-6)
    shade = (0.8 + 0.6 * (points[..., 2] - low) / height).reshape(-1, 1)  # higher is lighter
    mesh = rr.Mesh3D(
        vertex_positions=points.reshape(-1, 3),
        triangle_indices=triangles,
        vertex_colors=np.clip(shade * np.array(_GROUND_COLOR), 0, 255).astype(np.uint8),
    )
    timelines.stream.log(rr.new_entity_path(["world", name]), mesh, static=True)


def bounds(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and highest coordinates [m] that links and markers reach, each of shape (3,)."""
    paths = [body.positions.reshape(-1, 3) for body in scene.bodies if body.ground_height is None]
    points = np.concatenate([*paths, *scene.markers.values(), np.zeros((0, 3))])
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (-np.ones(3), np.ones(3))


def _draw_path(body: BodyMotion, timelines: Timelines) -> None:
    """Draw the path of a robot's trunk, or else of its last link, with one segment per step."""
    if not body.joint_names:
        return
    points = _path_points(body).astype(np.float32)
    entity = rr.new_entity_path(["world", "paths", body.name])
    timelines.stream.log(entity, rr.LineStrips3D.from_fields(radii=0.004, colors=_PATH_COLOR), static=True)
    segments = [points[step - 1 : step + 1] for step in range(1, len(points))]
    timelines.send(entity, range(1, len(points)), rr.LineStrips3D.columns(strips=segments))


def _path_points(body: BodyMotion) -> NDArray[np.float64]:
    if body.trunk is None:
        return body.positions[:, -1]
    centers = shape_centers(body, body.trunk)
    # The frame of an MJCF body may be far from its shapes.
    return centers[0] if body.file.suffix == ".xml" and len(centers) else body.positions[:, body.trunk]


def shape_centers(body: BodyMotion, link: int) -> NDArray[np.float64]:
    """Return the positions of the shapes of a link [m], world frame, shape (shapes, T + 1, 3)."""
    turns, position = body.orientations[:, link], body.positions[:, link]
    shapes = [shape for shape in body.shapes if shape.link == body.links[link]]
    centers = [position + _rotate(turns, np.array(shape.position)) for shape in shapes]
    return np.array(centers, np.float64).reshape(-1, *position.shape)


def _rotate(quaternions: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate a vector by each quaternion (x, y, z, w). SciPy does the same, but its import takes 0.2 s."""
    axes, scalars = quaternions[:, :3], quaternions[:, 3:]
    across = 2.0 * np.cross(axes, vector)
    return vector + scalars * across + np.cross(axes, across)


def draw_shapes(body: BodyMotion, timelines: Timelines, warn: Warn) -> list[str]:
    """Draw every shape of every link, and move the links; return the entities of the shapes."""
    drawn = []
    for link, name in enumerate(body.links):
        shapes = [shape for shape in body.shapes if shape.link == name]
        if not shapes:
            continue
        entity = rr.new_entity_path(["world", body.name, name])
        positions, orientations = body.positions[:, link], body.orientations[:, link]
        # A link that never moves has one row.
        rows = 1 if np.ptp(positions, axis=0).max() == np.ptp(orientations, axis=0).max() == 0.0 else len(positions)
        columns = rr.Transform3D.columns(translation=positions[:rows], quaternion=orientations[:rows])
        timelines.send(entity, range(rows), columns)
        for number, shape in enumerate(shapes):
            if (archetype := _make_archetype(shape)) is not None:
                part = f"{entity}/shape_{number}"
                timelines.stream.log(part, archetype, static=True)
                timelines.stream.log(part, _make_pose(shape), static=True)
                drawn.append(part)
    only_bullet_reads_it = not drawn and body.file.suffix == ".xml"
    if len(drawn) < len(body.shapes) or only_bullet_reads_it:
        warn(f"{body.file.name}: {len(drawn)} of {len(body.shapes)} shapes of {body.name!r} could be drawn")
    return drawn


def _make_pose(shape: Shape) -> rr.Transform3D:
    scale = shape.size if shape.kind == ShapeKind.MESH else None
    return rr.Transform3D(translation=shape.position, quaternion=rr.Quaternion(xyzw=shape.orientation), scale=scale)


def _make_archetype(shape: Shape) -> rr.AsComponents | None:
    color = [round(255 * channel) for channel in shape.color]
    solid = rr.components.FillMode.Solid
    if shape.kind == ShapeKind.BOX:
        return rr.Boxes3D(half_sizes=[[extent / 2 for extent in shape.size]], colors=[color], fill_mode=solid)
    if shape.kind == ShapeKind.SPHERE:
        half_sizes = shape.size if len(shape.size) == 3 else shape.size[:1] * 3
        return rr.Ellipsoids3D(half_sizes=[half_sizes], colors=[color], fill_mode=solid)
    if shape.kind == ShapeKind.CYLINDER:
        return rr.Cylinders3D(lengths=shape.size[0], radii=shape.size[1], colors=[color], fill_mode=solid)
    if shape.kind == ShapeKind.CAPSULE:
        length, radius = shape.size[:2]
        # Rerun's capsules start at the centre of one end; PyBullet's are centred.
        half = [[0.0, 0.0, -length / 2]]
        return rr.Capsules3D(lengths=length, radii=radius, translations=half, colors=[color], fill_mode=solid)
    if isinstance(shape.mesh, Mesh):
        return _draw_mesh(shape.mesh, color)
    if shape.mesh and shape.mesh.is_file() and shape.mesh.suffix.lower() in _MESHES:
        return rr.Asset3D(path=shape.mesh, albedo_factor=color)
    return None


def _draw_mesh(mesh: Mesh, color: list[int]) -> rr.Mesh3D:
    normals = np.zeros_like(mesh.vertices)
    first, second, third = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    for corner in range(3):  # the viewer draws a flat silhouette of a mesh without normals
        np.add.at(normals, mesh.triangles[:, corner], np.cross(second - first, third - first))
    return rr.Mesh3D(
        vertex_positions=mesh.vertices, triangle_indices=mesh.triangles, vertex_normals=normals, albedo_factor=color
    )
