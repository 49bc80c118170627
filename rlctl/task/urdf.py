"""Reads URDF files so that both engines load the same: finds meshes, replaces inertias that no body can have.

What an engine would change silently is changed here, in the XML that both are given. `rlctl.task.model_faults` lists
these changes.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError
from rlctl.task.mesh_paths import has_scheme, resolve_mesh

XmlElement = ElementTree.Element
Moments = NDArray[np.float64]
"""Principal moments of inertia in ascending order [kg m^2], shape (3,)."""

FRAME_MASS, FRAME_MOMENT = 1e-6, 1e-9  # [kg], [kg m^2], of a link without <inertial> on a body that has mass
GUESSED_MASS, GUESSED_MOMENT = 1.0, 1.0  # [kg], [kg m^2]: PyBullet's, of any other link without <inertial>
_SMALLEST_RADIUS = 1e-3  # [m], of gyration: for moments that are not above 0
_SMALLEST_MOMENT = FRAME_MASS * _SMALLEST_RADIUS**2  # [kg m^2]; MuJoCo refuses less than 1e-14
_MOST_NAMES = 4
_ROUNDING = 1e-12
_MARGIN = 1e-9
_LATIN = "latin-1"
_DECLARED = re.compile(rb"""\s*(?:\xef\xbb\xbf)?<\?xml[^>]*\bencoding\s*=\s*["']([A-Za-z][\w.-]*)["']""")
_SAME_AXIS = 1e-3  # [m], and [rad]
_PRODUCTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


@dataclasses.dataclass
class Urdf:
    """A URDF as an engine is to load it; `root` has absolute paths of meshes."""

    path: Path
    root: XmlElement | None
    """None for a file that is not XML: PyBullet reads more than XML allows."""
    problem: str = ""
    """Why it is not XML."""
    changed: bool = False
    """Whether an engine must read `root` instead of the file."""
    missing: list[str] = dataclasses.field(default_factory=list)
    """Meshes of collision shapes that were not found, each with its link."""
    undrawn: dict[str, str] = dataclasses.field(default_factory=dict)
    """Meshes of visual shapes that were not found, by link; its collision shapes are drawn if it has no other."""
    recolored: dict[str, int] = dataclasses.field(default_factory=dict)
    """Largest number of materials that a shape has, by link, where it is more than one; the first is used."""
    frames: list[str] = dataclasses.field(default_factory=list)
    """Links without `<inertial>` that weigh `FRAME_MASS`."""
    guessed: list[str] = dataclasses.field(default_factory=list)
    """Links without `<inertial>` that weigh `GUESSED_MASS`."""
    raised: dict[str, Moments] = dataclasses.field(default_factory=dict)
    """Principal moments by link that replace impossible ones."""
    impossible: dict[str, Moments] = dataclasses.field(default_factory=dict)
    """Those of the file."""
    wheels: dict[str, float] = dataclasses.field(default_factory=dict)
    """Widths of wheels by link [m], see `find_wheels`."""

    @property
    def text(self) -> str:
        """The XML that both engines load."""
        assert self.root is not None
        return ElementTree.tostring(self.root, encoding="unicode")

    def check_meshes(self) -> None:
        """Raise `TaskError` if a mesh of a collision shape is missing."""
        if self.missing:
            raise TaskError(
                f"{self.path}, {self.missing[0]} not found: neither below a folder above the file, nor in "
                "ROS_PACKAGE_PATH, nor in AMENT_PREFIX_PATH/share"
            )


def read_urdf(path: Path, *, fixed: bool = False, inertia_from_file: bool = True) -> Urdf:
    """Read a URDF file; `fixed` means that its base is held by the world.

    Raises `TaskError` for links and joints without a name, two joints of one name, several bases, which crash PyBullet,
    and masses that are not finite.
    """
    try:
        root = _parse(path.read_bytes().strip())
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two: an unknown encoding
        return Urdf(path, None, str(error))
    urdf = Urdf(path, root)
    _check_names(path, root)
    _check_masses(path, root)
    _find_meshes(urdf, root)
    _remove_repeated_materials(urdf, root)
    _add_masses(urdf, root, fixed)
    urdf.wheels = find_wheels(root)
    if inertia_from_file:
        _raise_moments(urdf, root)
    urdf.changed = urdf.changed or bool(urdf.frames or urdf.guessed or urdf.raised or urdf.undrawn or urdf.recolored)
    urdf.changed = urdf.changed or find_encoding(path.read_bytes()) == _LATIN
    return urdf


def find_encoding(data: bytes) -> str:
    """Return the encoding of a URDF: what it declares, or UTF-8, or Latin-1 if it is not that.

    Files that were saved as Latin-1 often declare nothing, or UTF-8.
    """
    declared = _DECLARED.match(data)
    name = declared[1].decode("ascii") if declared else "utf-8"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if name.lower() not in ("utf-8", "utf8", "us-ascii"):
        return name
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return _LATIN
    return "utf-8"


def _parse(data: bytes) -> XmlElement:
    if find_encoding(data) == _LATIN:
        return ElementTree.fromstring(data.decode(_LATIN))
    return ElementTree.fromstring(data)


def _check_names(path: Path, root: XmlElement) -> None:
    for joint in root.findall("joint"):
        child = joint.find("child")
        if not joint.get("name"):
            whose = f" to link {child.get('link')!r}" if child is not None else ""
            raise TaskError(f"{path}: the joint{whose} has no name; give it one")
    for number, link in enumerate(root.findall("link"), 1):
        if not link.get("name"):
            raise TaskError(f"{path}: link {number} has no name; give it one")
    names = [joint.get("name") for joint in root.findall("joint")]
    if (name := next((name for name in names if names.count(name) > 1), None)) is not None:
        raise TaskError(f"{path}: {names.count(name)} joints are called {name!r}; give each its own name")
    moved = {child.get("link") for child in root.iterfind("joint/child")}
    bases = [str(link.get("name")) for link in root.findall("link") if link.get("name") not in moved]
    if len(bases) > 1:
        shown = ", ".join(map(repr, bases[:_MOST_NAMES]))
        raise TaskError(f"{path}: {len(bases)} links are no joint's child ({shown}); a URDF has one base")


def _check_masses(path: Path, root: XmlElement) -> None:
    for link in root.findall("link"):
        mass = read_mass(link)
        if mass is not None and not math.isfinite(mass):
            raise TaskError(f"{path}: link {link.get('name')!r} has a mass of {mass:g} kg; write its mass")


def _find_meshes(urdf: Urdf, root: XmlElement) -> None:
    for link in root.findall("link"):
        for shape in [*link.findall("collision"), *link.findall("visual")]:
            for mesh in shape.iterfind(".//mesh[@filename]"):
                _find_mesh(urdf, link, shape, mesh)
        if link.get("name") in urdf.undrawn and link.find("visual") is None:
            _draw_collision_shapes(link)
    for texture in root.iterfind(".//texture[@filename]"):
        texture.set("filename", str(resolve_mesh(texture.get("filename", ""), urdf.path) or texture.get("filename")))


def _find_mesh(urdf: Urdf, link: XmlElement, shape: XmlElement, mesh: XmlElement) -> None:
    name, link_name = mesh.get("filename", ""), link.get("name", "")
    found = resolve_mesh(name, urdf.path)
    urdf.changed = urdf.changed or has_scheme(name)
    if found is not None:
        mesh.set("filename", str(found))
    elif shape.tag == "visual":
        urdf.undrawn[link_name] = name
        link.remove(shape)
    else:
        urdf.missing.append(f"link {link_name!r}: mesh {name!r}")


def _draw_collision_shapes(link: XmlElement) -> None:
    for shape in link.findall("collision"):
        drawn = copy.deepcopy(shape)
        drawn.tag = "visual"
        link.append(drawn)


def _remove_repeated_materials(urdf: Urdf, root: XmlElement) -> None:
    """Leave the first material of each shape, the one that PyBullet draws; MuJoCo refuses several.

    Converters of meshes write a material for each part of the mesh. Nothing but the colour depends on it.
    """
    for link in root.findall("link"):
        for shape in [*link.findall("collision"), *link.findall("visual")]:
            materials = shape.findall("material")
            for material in materials[1:]:
                shape.remove(material)
            if len(materials) > 1:
                name = link.get("name", "")
                urdf.recolored[name] = max(urdf.recolored.get(name, 0), len(materials))


def _add_masses(urdf: Urdf, root: XmlElement, fixed: bool) -> None:
    """Give mass to links without `<inertial>`: hardly any to frames, 1 kg where a joint would move nothing else."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    joints = [joint for joint in _list_joints(root) if {joint.parent, joint.child} <= set(links)]
    masses = {name: read_mass(link) for name, link in links.items()}
    children = {joint.child for joint in joints}
    base = next((name for name in links if name not in children), "")
    for name, link in links.items():
        if masses[name] is not None or (fixed and name == base):
            continue
        top = _find_top(name, joints)
        carried = _list_carried(top, joints, through_joints=top != base)
        is_frame = (fixed and top == base) or any((masses[other] or 0.0) > 0 for other in carried)
        (urdf.frames if is_frame else urdf.guessed).append(name)
        mass, moment = (FRAME_MASS, FRAME_MOMENT) if is_frame else (GUESSED_MASS, GUESSED_MOMENT)
        if (old := link.find("inertial")) is not None:
            link.remove(old)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "mass", value=repr(mass))
        _write_products(ElementTree.SubElement(inertial, "inertia"), moment * np.eye(3))


@dataclasses.dataclass(frozen=True)
class _Joint:
    parent: str
    child: str
    is_fixed: bool


def _list_joints(root: XmlElement) -> Iterator[_Joint]:
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            yield _Joint(parent.get("link", ""), child.get("link", ""), joint.get("type") == "fixed")


def find_wheels(root: XmlElement) -> dict[str, float]:
    """Return the widths of wheels by link [m]: collision cylinders on a joint without limits, about the same axis."""
    links = {str(link.get("name")): link for link in root.findall("link")}
    wheels: dict[str, float] = {}
    for joint in root.findall("joint"):
        child = joint.find("child")
        name = "" if child is None else child.get("link", "")
        if joint.get("type") != "continuous" or name not in links:
            continue
        axis = _read_vector(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
        for shape in links[name].findall("collision"):
            cylinder = shape.find("geometry/cylinder")
            if cylinder is not None and _is_about(axis, shape.find("origin")):
                wheels[name] = max(wheels.get(name, 0.0), read_number(cylinder, "length"))
    return wheels


def _is_about(axis: NDArray[np.float64], place: XmlElement | None) -> bool:
    """Return whether the z axis of a shape is that of a joint, both in the frame of the link."""
    length = float(np.linalg.norm(axis))
    if not length > 0:
        return False
    roll, pitch, yaw = _read_vector(place, "rpy", (0.0, 0.0, 0.0))
    along = np.array(
        [
            math.cos(yaw) * math.sin(pitch) * math.cos(roll) + math.sin(yaw) * math.sin(roll),
            math.sin(yaw) * math.sin(pitch) * math.cos(roll) - math.cos(yaw) * math.sin(roll),
            math.cos(pitch) * math.cos(roll),
        ]
    )
    off_axis = np.linalg.norm(np.cross(_read_vector(place, "xyz", (0.0, 0.0, 0.0)), axis)) / length  # [m]
    tilt = np.linalg.norm(np.cross(along, axis)) / length  # the sine of the angle
    return bool(off_axis < _SAME_AXIS and tilt < _SAME_AXIS)


def _read_vector(element: XmlElement | None, name: str, default: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return an attribute of three numbers, or `default`; engines complain of one that is something else."""
    text = "" if element is None else element.get(name, "")
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        return np.array(default)
    return values if values.shape == (3,) else np.array(default)


def _find_top(link: str, joints: list[_Joint]) -> str:
    """Return the link to which `link` is welded and that a joint moves, or the base."""
    by_child = {joint.child: joint for joint in joints if joint.is_fixed}
    seen = {link}
    while link in by_child and by_child[link].parent not in seen:
        link = by_child[link].parent
        seen.add(link)
    return link


def _list_carried(top: str, joints: list[_Joint], *, through_joints: bool) -> set[str]:
    """Return the links that move with `top`: those welded to it, and those further out if `through_joints`."""
    carried, waiting = {top}, [top]
    while waiting:
        parent = waiting.pop()
        new = {joint.child for joint in joints if joint.parent == parent and (joint.is_fixed or through_joints)}
        waiting += sorted(new - carried)
        carried |= new
    return carried


def read_mass(link: XmlElement) -> float | None:
    """Return the mass of a link [kg]; None if the file has none, 0 if it is not a number."""
    mass = link.find("inertial/mass")
    return None if mass is None else read_number(mass, "value")


def read_number(element: XmlElement, name: str) -> float:
    """Return an attribute, or 0 if it is not a number; engines say so themselves, or `model_faults` does."""
    try:
        return float(element.get(name, 0.0))
    except ValueError:
        return 0.0


def read_products(link: XmlElement) -> NDArray[np.float64] | None:
    """Return the inertia matrix of a link in the file [kg m^2], shape (3, 3); None if it has none, or no numbers."""
    inertia = link.find("inertial/inertia")
    try:
        if inertia is None:
            return None
        ixx, iyy, izz, ixy, ixz, iyz = (float(inertia.get(name, 0.0)) for name in _PRODUCTS)
    except ValueError:
        return None
    matrix = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    return matrix if np.isfinite(matrix).all() else None


def _write_products(inertia: XmlElement, matrix: NDArray[np.float64]) -> None:
    places = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    for name, place in zip(_PRODUCTS, places, strict=True):
        inertia.set(name, repr(float(matrix[place])))


def _raise_moments(urdf: Urdf, root: XmlElement) -> None:
    for link in root.findall("link"):
        mass, matrix = read_mass(link), read_products(link)
        if not mass or mass < 0 or matrix is None:
            continue
        moments, axes = np.linalg.eigh(matrix)
        possible = find_possible_moments(moments, mass)
        if possible is not None:
            inertia = link.find("inertial/inertia")
            assert inertia is not None
            _write_products(inertia, axes @ np.diag(possible) @ axes.T)
            name = str(link.get("name"))
            urdf.impossible[name], urdf.raised[name] = moments, possible


def find_possible_moments(moments: Moments, mass: float) -> Moments | None:
    """Return principal moments that a body of `mass` [kg] can have; None if it can have `moments`.

    Moments that are not above 0 become those of a radius of gyration of 1 mm; for a frame link of less than 1 mg, as
    generators of URDF write them, those of 1 mg. Then, if the largest exceeds the sum of the others, both of these
    are raised by the same amount until it does not. PyBullet sets all three to 0, MuJoCo refuses the file.
    """
    low, middle, high = (float(moment) for moment in moments)
    if low >= _SMALLEST_MOMENT and high <= (low + middle) * (1 + _ROUNDING):
        return None
    possible = np.maximum(np.sort(np.where(moments > 0, moments, mass * _SMALLEST_RADIUS**2)), _SMALLEST_MOMENT)
    lack = possible[2] * (1 + _MARGIN) - possible[0] - possible[1]
    if lack > 0:
        possible[:2] += lack / 2
    return possible
