"""The shapes of an MJCF file, read from the file.

PyBullet cannot list them: getVisualShapeData loses the pose of a geom that is given by its ends (`fromto`), and
getCollisionShapeData crashes on some robots. Recordings show what was simulated, so this module interprets the file as
PyBullet 3.2 does: `axisangle` is always in radians; `euler`, `zaxis` and `xyaxes` are ignored.
"""

import dataclasses
import enum
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np


class ShapeKind(enum.Enum):
    """The kind of a shape; `OTHER` cannot be drawn."""

    SPHERE = "sphere"
    CAPSULE = "capsule"
    CYLINDER = "cylinder"
    BOX = "box"
    PLANE = "plane"
    MESH = "mesh"
    OTHER = "other"


@dataclasses.dataclass(frozen=True)
class Mesh:
    """A mesh in memory."""

    vertices: np.ndarray  # [m], shape (vertices, 3)
    triangles: np.ndarray  # indices of vertices, shape (triangles, 3)
    uvs: np.ndarray | None = (
        None  # coordinates in the texture from its upper left corner, in [0, 1], shape (vertices, 2)
    )
    texture: Path | None = None  # a picture


@dataclasses.dataclass(frozen=True)
class Shape:
    """One visual shape of a link: a kind, sizes [m], a pose in the frame of its link, a colour."""

    link: str
    kind: ShapeKind
    size: tuple[float, ...]
    """Box: full extents; sphere: radius, or one per axis; cylinder, capsule: length, radius; mesh: scale per axis."""
    mesh: Path | Mesh | None
    position: tuple[float, ...]
    orientation: tuple[float, ...]
    color: tuple[float, ...]  # RGBA in [0, 1]


_KINDS = {kind.value: kind for kind in ShapeKind if kind not in (ShapeKind.MESH, ShapeKind.OTHER)}
_COLOR = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's, RGBA
_OUTERMOST = "main"  # MJCF's class of geoms without a class
_Defaults = Mapping[str, Mapping[str, str]]  # attributes of geoms, by class


def read_shapes(file: Path) -> list[Shape]:
    """Return the geoms of a file; the `link` of a shape is the name of its MJCF body.

    PyBullet makes a body of each geom that belongs to the world, and names its base like the geom.

    Raises `ValueError` where the file cannot be read.
    """
    try:
        root = ElementTree.parse(file).getroot()
        group = root.find("default")
        defaults = dict(_defaults(group, {}))
        outermost = _OUTERMOST if group is None else group.get("class", _OUTERMOST)
        of_bodies = [shape for body in root.iterfind("worldbody/body") for shape in _of_body(body, defaults, outermost)]
        named = [geom for geom in root.iterfind("worldbody/geom") if geom.get("name") and geom.get("type") != "plane"]
        return of_bodies + [_shape(geom.get("name", ""), _complete(geom, defaults, outermost)) for geom in named]
    except (OSError, ElementTree.ParseError) as error:
        raise ValueError(f"{file}: {error}") from error


def _defaults(group: ElementTree.Element | None, outer: Mapping[str, str]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield each default class with its attributes of geoms, own and inherited."""
    if group is None:
        return
    geom = group.find("geom")
    attributes = {**outer, **({} if geom is None else geom.attrib)}
    yield group.get("class", _OUTERMOST), attributes
    for inner in group.iterfind("default"):
        yield from _defaults(inner, attributes)


def _of_body(body: ElementTree.Element, defaults: _Defaults, around: str) -> Iterator[Shape]:
    inherited = body.get("childclass", around)
    for geom in body.iterfind("geom"):
        yield _shape(body.get("name", ""), _complete(geom, defaults, inherited))
    for child in body.iterfind("body"):
        yield from _of_body(child, defaults, inherited)


def _complete(geom: ElementTree.Element, defaults: _Defaults, inherited: str) -> Mapping[str, str]:
    return {**defaults.get(geom.get("class", inherited), {}), **geom.attrib}


def _shape(link: str, geom: Mapping[str, str]) -> Shape:
    kind = _KINDS.get(geom.get("type", "sphere"), ShapeKind.MESH)  # a mesh without a file: not drawn
    size, ends = _numbers(geom, "size"), _numbers(geom, "fromto")
    position, orientation, length = _numbers(geom, "pos") or (0.0, 0.0, 0.0), _orientation(geom), 0.0
    if ends and kind in (ShapeKind.CAPSULE, ShapeKind.CYLINDER):
        position, orientation, length = _between(np.array(ends[:3]), np.array(ends[3:]))
    elif len(size) > 1:
        length = 2 * size[1]
    if kind == ShapeKind.BOX:
        size = tuple(2 * half for half in size)
    elif kind in (ShapeKind.CAPSULE, ShapeKind.CYLINDER):
        size = (length, size[0])
    return Shape(link, kind, size, None, position, orientation, _numbers(geom, "rgba") or _COLOR)


def _numbers(geom: Mapping[str, str], attribute: str) -> tuple[float, ...]:
    return tuple(float(word) for word in geom.get(attribute, "").split())


def _orientation(geom: Mapping[str, str]) -> tuple[float, ...]:
    """Return the quaternion (x, y, z, w) of a geom in its body; MJCF writes (w, x, y, z)."""
    if quaternion := _numbers(geom, "quat"):
        w, *vector = np.array(quaternion) / np.linalg.norm(quaternion)
        return (*map(float, vector), float(w))
    if turn := _numbers(geom, "axisangle"):
        axis = np.array(turn[:3]) / np.linalg.norm(turn[:3])
        return (*(math.sin(turn[3] / 2) * axis).tolist(), math.cos(turn[3] / 2))
    return (0.0, 0.0, 0.0, 1.0)


def _between(start: np.ndarray, end: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Return the centre [m], quaternion and length [m] of a shape whose z axis reaches from `start` to `end`."""
    along = end - start
    length = float(np.linalg.norm(along))
    direction = along / length if length else np.array([0.0, 0.0, 1.0])
    x, y, z = direction.tolist()
    # The shortest turn from the z axis; half a turn about any horizontal axis if the direction is opposite.
    turn = np.array([-y, x, 0.0, 1.0 + z]) if z > -1.0 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])
    return tuple(((start + end) / 2).tolist()), tuple((turn / np.linalg.norm(turn)).tolist()), length


def connect_grid(rows: int, columns: int) -> np.ndarray:
    """Return the triangles between points of a grid, whose second index goes fastest; shape (triangles, 3)."""
    corner = np.arange(rows * columns).reshape(rows, columns)[:-1, :-1].ravel()
    right, above = corner + columns, corner + 1
    return np.concatenate([np.stack([corner, right, right + 1], 1), np.stack([corner, right + 1, above], 1)])
