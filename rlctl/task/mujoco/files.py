"""Model files for MuJoCo: URDF and MJCF as `MjSpec`, and what of a URDF MuJoCo does not read."""

from __future__ import annotations

import dataclasses
import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rlctl.errors import TaskError
from rlctl.task.meshes import convert_mesh, count_vertices
from rlctl.task.mujoco.hulls import delete_unused_meshes, use_hulls
from rlctl.task.mujoco.world import import_mujoco
from rlctl.task.urdf import Urdf, read_urdf

_FEWEST_VERTICES = 4  # of a mesh in MuJoCo
_GROUND = "ground"  # the body of a file that has none
_FRICTION = 0.5  # PyBullet's, of a link whose file gives none


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """A model file and its `MjSpec`."""

    path: Path
    spec: Any
    max_force: dict[str, float]  # effort limit by joint [N m or N]; 0 where there is none
    max_speed: dict[str, float]  # [rad/s or m/s]; 0 where there is none
    friction: dict[str, float]  # lateral friction by link
    spin: dict[str, float]  # spinning friction by link [m]
    moved_by: dict[str, str]  # link that a joint moves, by joint; fixed joints too
    inertia_from_file: bool = False
    roll: dict[str, float] = dataclasses.field(default_factory=dict)  # rolling friction by link [m]


def read_model_file(
    path: Path,
    *,
    fixed: bool = False,
    inertia: Literal["file", "shape"] = "file",
    visuals: bool = True,
    hulls: bool = True,
) -> ModelFile:
    """Read a URDF or MJCF file; raises `TaskError` with MuJoCo's message for one that it refuses.

    With `visuals` the geoms include the visual shapes of a URDF, in group 1; its collision shapes are in group 0.
    Without it those of an MJCF file are left out, too, as far as nothing refers to them. `hulls=False` keeps the meshes
    with which shapes collide as the files have them.
    """
    if path.suffix not in (".urdf", ".xml"):
        first = f"; first: xacro {path.name} > {path.name.split('.')[0]}.urdf" if path.suffix == ".xacro" else ""
        raise TaskError(f"{path}: MuJoCo reads URDF and MJCF (.xml) files{first}")
    if path.suffix == ".xml":
        spec = _call_reader(path, lambda: import_mujoco().MjSpec.from_file(str(path)))
        if spec.worldbody.first_body() is None:
            spec = _put_into_body(spec)
        described = _describe_mjcf(path, _prepare_mjcf(spec))
        if not visuals:
            _delete_visuals(spec)
        if hulls:
            _call_reader(path, lambda: use_hulls(spec, _list_mesh_files(path, spec)))
        return described
    urdf = read_urdf(path, fixed=fixed, inertia_from_file=inertia == "file")
    if urdf.root is None:
        raise TaskError(f"MuJoCo cannot load {path}: {urdf.problem}")
    urdf.check_meshes()
    spec = _call_reader(path, lambda: _parse_urdf(urdf, visuals=visuals, hulls=hulls))
    if visuals and any(geom.meshname for geom in spec.geoms if not is_colliding(geom)):
        try:
            spec.copy().compile()
        except ValueError:  # because of a visual mesh, or it will fail again
            spec = _call_reader(path, lambda: _parse_urdf(urdf, visuals=False, hulls=hulls))
    if inertia == "shape":
        _call_reader(path, lambda: _take_inertia_of_shapes(spec))
    return _describe_urdf(path, spec, urdf.root, inertia == "file")


def is_colliding(geom: Any) -> bool:
    """Return whether a geom of a model file is a collision shape."""
    return bool(geom.contype or geom.conaffinity)


def _call_reader(path: Path, read: Callable[[], Any]) -> Any:
    try:
        return read()
    except ValueError as error:
        raise TaskError(f"MuJoCo cannot load {path}: {' '.join(str(error).split())}") from None


def _put_into_body(spec: Any) -> Any:
    """Return the spec of a file whose shapes are all of the world, such as terrain, with a body that has them."""
    outer = import_mujoco().MjSpec()
    outer.modelfiledir, outer.meshdir, outer.texturedir = spec.modelfiledir, spec.meshdir, spec.texturedir
    ground = outer.worldbody.add_body(name=_GROUND)
    outer.attach(spec, frame=ground.add_frame(), prefix=f"{_GROUND}/")
    return outer


def _prepare_mjcf(spec: Any) -> Any:
    spec.compiler.fusestatic = False  # links on fixed joints keep their names
    kinds = {"body": spec.bodies[1:], "joint": spec.joints, "actuator": spec.actuators}
    for kind, elements in kinds.items():
        for number, element in enumerate(elements):
            element.name = element.name or f"{kind} {number}"
    for pair in spec.pairs:
        spec.delete(pair)  # `Sim.load` defines which links collide
    return spec


def _delete_visuals(spec: Any) -> None:
    """Delete shapes that are only seen; those with names, which others may refer to, and with mass are kept."""
    seen = [geom for geom in spec.geoms if not is_colliding(geom) and not geom.name and geom.parent.explicitinertial]
    meshes = {geom.meshname for geom in seen}
    for geom in seen:
        spec.delete(geom)
    delete_unused_meshes(spec, meshes)


def _list_mesh_files(path: Path, spec: Any) -> dict[str, Path]:
    return {mesh.name: path.parent / spec.meshdir / mesh.file for mesh in spec.meshes if mesh.file}


def _parse_urdf(urdf: Urdf, *, visuals: bool, hulls: bool) -> Any:
    """Return the `MjSpec` of a URDF; a mesh that MuJoCo does not read is converted, or left out if it is visual."""
    mujoco, root = import_mujoco(), ElementTree.fromstring(urdf.text)
    assets: dict[str, bytes] = {}
    converted_from: dict[str, Path] = {}  # by name in `assets`
    for link in root.findall("link"):
        for shape in link.findall("visual"):
            if not visuals or not all(_can_be_drawn(mesh) for mesh in shape.iterfind(".//mesh[@filename]")):
                link.remove(shape)
    for mesh in root.iterfind(".//mesh[@filename]"):
        file = Path(mesh.get("filename", ""))
        if (converted := convert_mesh(file)) is not None:
            # MuJoCo keeps meshes in memory, by name.
            name = f"{file.with_suffix('')}-{hashlib.sha256(converted).hexdigest()[:16]}.msh"
            assets[name], converted_from[name] = converted, file
            mesh.set("filename", name)
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.attrib |= {"strippath": "false", "discardvisual": "false", "fusestatic": "false"}
    compiler.attrib.pop("meshdir", None)  # all paths are absolute
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"), assets=assets)
    except ValueError:
        mujoco.MjSpec.from_file(str(urdf.path))  # it has the file's numbers of lines in its message
        raise
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    if hulls:
        use_hulls(spec, {mesh.name: converted_from.get(mesh.file, Path(mesh.file)) for mesh in spec.meshes})
    colliding = {geom.meshname for geom in spec.geoms if is_colliding(geom)}
    for mesh in [mesh for mesh in spec.meshes if mesh.name not in colliding]:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # what is only drawn may be flat
    return spec


def _can_be_drawn(mesh: ElementTree.Element) -> bool:
    try:
        return count_vertices(Path(mesh.get("filename", ""))) >= _FEWEST_VERTICES
    except (OSError, ValueError, LookupError, ElementTree.ParseError, StopIteration):
        return False


def _take_inertia_of_shapes(spec: Any) -> None:
    """Compute each link's inertia from its collision shapes, with the mass and the centre of mass of the file."""
    bodies = {body.name: body for body in spec.bodies[1:] if any(map(is_colliding, body.geoms)) and body.mass > 0}
    shaped = spec.copy()
    shaped.compiler.inertiafromgeom = import_mujoco().mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    model = shaped.compile()
    for name, body in bodies.items():
        number = model.body(name).id
        body.fullinertia = [np.nan] * 6
        body.iquat = model.body_iquat[number]
        body.inertia = model.body_inertia[number] * body.mass / model.body_mass[number]


def _describe_urdf(path: Path, spec: Any, root: ElementTree.Element, inertia_from_file: bool) -> ModelFile:
    joints = {str(joint.get("name")): joint for joint in root.findall("joint")}
    links = {str(link.get("name")): link for link in root.findall("link")}
    return ModelFile(
        path,
        spec,
        {name: _read(joint, "limit", "effort") for name, joint in joints.items()},
        {name: _read(joint, "limit", "velocity") for name, joint in joints.items()},
        # MuJoCo ignores PyBullet's `contact` tags.
        {name: _read(link, "contact/lateral_friction", default=_FRICTION) for name, link in links.items()},
        {name: _read(link, "contact/spinning_friction") for name, link in links.items()},
        {name: str(child.get("link")) for name, joint in joints.items() if (child := joint.find("child")) is not None},
        inertia_from_file,
        {name: _read(link, "contact/rolling_friction") for name, link in links.items()},
    )


def _describe_mjcf(path: Path, spec: Any) -> ModelFile:
    frictions = {geom.parent.name: float(geom.friction[0]) for geom in spec.geoms}
    moved = {joint.name: joint.parent.name for joint in spec.joints}
    forces = {joint.name: _find_force(spec, joint) for joint in spec.joints}
    bodies = [body.name for body in spec.bodies]
    friction = {name: frictions.get(name, 1.0) for name in bodies}
    return ModelFile(path, spec, forces, dict.fromkeys(moved, 0.0), friction, dict.fromkeys(bodies, 0.0), moved)


def _find_force(spec: Any, joint: Any) -> float:
    """Return the force limit of an MJCF joint: its own, or what its actuators can give."""
    if np.any(joint.actfrcrange):
        return float(np.max(np.abs(joint.actfrcrange)))
    moving = [actuator for actuator in spec.actuators if actuator.target == joint.name]
    if not moving:
        return 0.0
    actuator, is_motor = moving[0], int(moving[0].biastype) == 0  # else it is a spring or a damper
    ranges = actuator.forcerange
    if not np.any(ranges) and is_motor:
        ranges = actuator.gainprm[0] * np.array(actuator.ctrlrange)
    return float(np.max(np.abs(ranges)) * abs(actuator.gear[0]))


def _read(element: ElementTree.Element, path: str, name: str = "value", default: float = 0.0) -> float:
    part = element.find(path)
    return default if part is None else float(part.get(name, default))
