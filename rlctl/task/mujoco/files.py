"""Model files for MuJoCo: URDF and MJCF as `MjSpec`, and what of a URDF MuJoCo does not read."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.errors import TaskError
from rlctl.task.mujoco.world import import_mujoco

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


def read_model_file(path: Path) -> ModelFile:
    """Read a URDF or MJCF file; raises `TaskError` with MuJoCo's message for one that it refuses."""
    if path.suffix not in (".urdf", ".xml"):
        raise TaskError(f"{path}: MuJoCo reads URDF and MJCF (.xml) files")
    root = None
    try:
        if path.suffix == ".urdf":
            root = ElementTree.fromstring(path.read_bytes().strip())
        spec = import_mujoco().MjSpec.from_file(str(path))
    except ElementTree.ParseError as error:
        raise TaskError(f"MuJoCo cannot load {path}: {error}") from None
    except ValueError as error:
        raise TaskError(f"MuJoCo cannot load {path}: {' '.join(str(error).split())}") from None
    spec.compiler.fusestatic = False  # links on fixed joints keep their names
    return _describe_mjcf(path, spec) if root is None else _describe_urdf(path, spec, root)


def _describe_urdf(path: Path, spec: Any, root: ElementTree.Element) -> ModelFile:
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
    )


def _describe_mjcf(path: Path, spec: Any) -> ModelFile:
    frictions = {geom.parent.name: float(geom.friction[0]) for geom in spec.geoms}
    moved = {joint.name: joint.parent.name for joint in spec.joints}
    forces = {joint.name: _find_force(spec, joint) for joint in spec.joints}
    bodies = [body.name for body in spec.bodies[1:]]
    friction = {name: frictions.get(name, 1.0) for name in bodies}
    return ModelFile(path, spec, forces, dict.fromkeys(moved, 0.0), friction, dict.fromkeys(bodies, 0.0), moved)


def _find_force(spec: Any, joint: Any) -> float:
    """Return the force limit of an MJCF joint: its own, or what its actuators can give."""
    if joint.actfrclimited:
        return float(np.max(np.abs(joint.actfrcrange)))
    moving = [actuator for actuator in spec.actuators if actuator.target == joint.name]
    if not moving:
        return 0.0
    actuator = moving[0]
    ranges = actuator.forcerange if np.any(actuator.forcerange) else actuator.gainprm[0] * np.array(actuator.ctrlrange)
    return float(np.max(np.abs(ranges)) * abs(actuator.gear[0]))


def _read(element: ElementTree.Element, path: str, name: str = "value", default: float = 0.0) -> float:
    part = element.find(path)
    return default if part is None else float(part.get(name, default))
