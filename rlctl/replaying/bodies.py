"""Draws a world in a recording: the shapes of bodies, markers, paths."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rlctl.replaying.curves import Timelines
from rlctl.replaying.meshes import load_mesh
from rlctl.replaying.mjcf import Mesh, Shape, ShapeKind, connect_grid
from rlctl.replaying.scene import WORLD, BodyMotion, Line, Scene, Warn
from rlctl.task.rotations import rotate

_MARKER_COLORS = [(40, 200, 90), (70, 150, 255), (240, 120, 200), (250, 180, 40)]
_HALO_RADIUS = 0.09  # [m]
_LINE_RADIUS = 0.004  # [m]
_PATH_COLOR = (255, 80, 180)
_GROUND_COLOR = (70, 74, 82)
_LARGEST_TEXTURE = 1024  # [pixels]
_MESHES = {".obj", ".stl", ".dae", ".glb", ".gltf"}


def draw_scene(scene: Scene, timelines: Timelines, warn: Warn) -> dict[str, tuple[str, BodyMotion]]:
    """Draw each world under an entity of its name; `warn` receives messages about what could not be drawn.

    Returns what the camera of a world follows: the first robot with a trunk that was drawn, and the trunk's entity.
    """
    followed: dict[str, tuple[str, BodyMotion]] = {}
    timelines.stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for body in scene.bodies:
        if body.ground_height is not None:
            _draw_ground(body, scene, timelines)
        elif body.terrain is not None:
            _draw_terrain(body.name, body.terrain, timelines)
        else:
            drawn = draw_shapes(body, timelines, warn)
            if body.trunk is not None:
                trunk = rr.new_entity_path([body.world, body.name, body.links[body.trunk]]) + "/"
                if parts := [entity for entity in drawn if entity.startswith(trunk)]:
                    followed.setdefault(body.world, (parts[0], body))
        _draw_path(body, timelines)
    for number, (name, positions) in enumerate(scene.markers.items()):
        _draw_marker(name, positions, _MARKER_COLORS[number % len(_MARKER_COLORS)], timelines)
    for (world, kind), lines in scene.lines.items():
        _draw_lines(rr.new_entity_path([world, kind]), lines, timelines)
    return followed


def _draw_lines(entity: str, lines: list[list[Line]], timelines: Timelines) -> None:
    """Draw the lines of each step."""
    timelines.stream.log(entity, rr.LineStrips3D.from_fields(radii=_LINE_RADIUS), static=True)
    strips = np.array([(line.start, line.end) for row in lines for line in row], np.float32).reshape(-1, 2, 3)
    colors = np.array([line.color for row in lines for line in row], np.float64).reshape(-1, 3)
    columns = rr.LineStrips3D.columns(strips=list(strips), colors=np.round(255 * colors).astype(np.uint8))
    timelines.send(entity, range(len(lines)), columns.partition([len(row) for row in lines]))


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
    low, high = bounds(scene, body.world)
    center, half = (low + high)[:2] / 2, max(2.0, float((high - low)[:2].max()))
    thickness = 0.01
    box = rr.Boxes3D(
        centers=[[*center, (body.ground_height or 0.0) - thickness]],
        half_sizes=[[half, half, thickness / 2]],
        colors=[_GROUND_COLOR],
        fill_mode=rr.components.FillMode.Solid,
    )
    _log_existing(rr.new_entity_path([body.world, body.name]), box, body, timelines)
    _clear(body, timelines)


def _draw_terrain(name: str, points: NDArray[np.float64], timelines: Timelines) -> None:
    rows, columns, _ = points.shape
    low, height = points[..., 2].min(), max(float(np.ptp(points[..., 2])), 1e-6)
    shade = (0.8 + 0.6 * (points[..., 2] - low) / height).reshape(-1, 1)  # higher is lighter
    mesh = rr.Mesh3D(
        vertex_positions=points.reshape(-1, 3),
        triangle_indices=connect_grid(rows, columns),
        vertex_colors=np.clip(shade * np.array(_GROUND_COLOR), 0, 255).astype(np.uint8),
    )
    timelines.stream.log(rr.new_entity_path(["world", name]), mesh, static=True)


def bounds(scene: Scene, world: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and highest coordinates [m] that links and markers of a world reach, each of shape (3,)."""
    bodies = [body for body in scene.bodies if body.world == world and body.ground_height is None]
    markers = scene.markers.values() if world == WORLD else ()
    points = np.concatenate([*(body.positions.reshape(-1, 3) for body in bodies), *markers, np.zeros((0, 3))])
    points = points[np.isfinite(points).all(axis=1)]
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (-np.ones(3), np.ones(3))


def _draw_path(body: BodyMotion, timelines: Timelines) -> None:
    """Draw the path of a robot's trunk, or else of its last link, with one segment per step."""
    if not body.has_path:
        return
    points = _path_points(body).astype(np.float32)
    entity = rr.new_entity_path([body.world, "paths", body.name])
    timelines.stream.log(entity, rr.LineStrips3D.from_fields(radii=0.004, colors=_PATH_COLOR), static=True)
    steps = [step for span in body.list_spans() for step in span[1:]]
    segments = [points[step - 1 : step + 1] for step in steps]
    timelines.send(entity, steps, rr.LineStrips3D.columns(strips=segments))


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
    centers = [position + rotate(turns, shape.position) for shape in shapes]
    return np.array(centers, np.float64).reshape(-1, *position.shape)


def draw_shapes(body: BodyMotion, timelines: Timelines, warn: Warn) -> list[str]:
    """Draw every shape of every link, and move the links; return the entities of the shapes."""
    drawn = []
    for link, name in enumerate(body.links):
        numbers = [number for number, shape in enumerate(body.shapes) if shape.link == name]
        if not numbers:
            continue
        entity = rr.new_entity_path([body.world, body.name, name])
        _send_poses(entity, body, link, timelines)
        for part, number in enumerate(numbers):
            if (archetype := _make_archetype(body.shapes[number])) is not None:
                drawn.append(f"{entity}/shape_{part}")
                timelines.stream.log(drawn[-1], _make_pose(body.shapes[number]), static=True)
                colors = {step: row[number] for step, row in body.colors.items()}
                _log_existing(drawn[-1], archetype, body, timelines, colors)
    _clear(body, timelines)
    only_bullet_reads_it = not drawn and body.file.suffix == ".xml"
    if len(drawn) < len(body.shapes) or only_bullet_reads_it:
        warn(f"{body.file.name}: {len(drawn)} of {len(body.shapes)} shapes of {body.name!r} could be drawn")
    return drawn


def _send_poses(entity: str, body: BodyMotion, link: int, timelines: Timelines) -> None:
    poses = np.concatenate([body.positions[:, link], body.orientations[:, link]], axis=1)
    spans = body.list_spans()
    steps = [step for span in spans for step in span]
    if steps and np.ptp(poses[steps], axis=0).max() == 0.0:
        steps = [span[0] for span in spans]  # a link that never moves has one row each time that it appears
    columns = rr.Transform3D.columns(translation=poses[steps, :3], quaternion=poses[steps, 3:])
    timelines.send(entity, steps, columns)


def _log_existing(
    entity: str,
    archetype: rr.AsComponents,
    body: BodyMotion,
    timelines: Timelines,
    colors: Mapping[int, Sequence[float]] | None = None,
) -> None:
    """Log an archetype in the steps in which its body existed; `colors`: RGBA in [0, 1], by their first step."""
    colors = colors or {}
    if body.exists_always and len(set(map(tuple, colors.values()))) < 2:
        timelines.stream.log(entity, archetype, static=True)
        return
    # Static data would hide these.
    for span in body.list_spans():
        timelines.log(entity, span[0], archetype)
        before = [step for step in colors if step <= span[0]]
        for step in [*before[-1:], *(step for step in colors if step in span[1:])]:
            timelines.log(entity, max(step, span[0]), _make_paint(archetype, colors[step]))


def _make_paint(archetype: rr.AsComponents, color: Sequence[float]) -> rr.AsComponents:
    if isinstance(archetype, rr.Mesh3D | rr.Asset3D):
        return type(archetype).from_fields(albedo_factor=_round_color(color))
    return type(archetype).from_fields(colors=[_round_color(color)])  # type: ignore[attr-defined]


def _clear(body: BodyMotion, timelines: Timelines) -> None:
    """Remove a body from the steps in which it did not exist."""
    for span in body.list_spans():
        if span.stop < len(body.positions):
            timelines.log(rr.new_entity_path([body.world, body.name]), span.stop, rr.Clear(recursive=True))


def _round_color(color: Sequence[float]) -> list[int]:
    return [round(255 * channel) for channel in color]


def _make_pose(shape: Shape) -> rr.Transform3D:
    scale = shape.size if shape.kind == ShapeKind.MESH else None
    return rr.Transform3D(translation=shape.position, quaternion=rr.Quaternion(xyzw=shape.orientation), scale=scale)


def _make_archetype(shape: Shape) -> rr.AsComponents | None:
    color = _round_color(shape.color)
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
    mesh = load_mesh(shape.mesh) if isinstance(shape.mesh, Path) else shape.mesh
    if mesh is not None:
        return _draw_mesh(mesh, color)
    if isinstance(shape.mesh, Path) and shape.mesh.is_file() and shape.mesh.suffix.lower() in _MESHES:
        return rr.Asset3D(path=shape.mesh, albedo_factor=color)
    return None


def _draw_mesh(mesh: Mesh, color: list[int]) -> rr.Mesh3D:
    normals = np.zeros_like(mesh.vertices)
    first, second, third = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    for corner in range(3):  # the viewer draws a flat silhouette of a mesh without normals
        np.add.at(normals, mesh.triangles[:, corner], np.cross(second - first, third - first))
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.triangles,
        vertex_normals=normals,
        vertex_texcoords=mesh.uvs,
        albedo_factor=color,
        albedo_texture=None if mesh.texture is None else _read_picture(mesh.texture),
    )


def _read_picture(file: Path) -> NDArray[np.uint8] | None:
    from PIL import Image

    try:
        with Image.open(file) as image:
            image.thumbnail((_LARGEST_TEXTURE, _LARGEST_TEXTURE))
            return np.asarray(image.convert("RGB"))
    except OSError:  # another format, or damaged: the mesh has its colour only
        return None
