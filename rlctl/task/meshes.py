"""Reads mesh files: OBJ, and those that MuJoCo does not: COLLADA (`.dae`), STL as text, STL of too many triangles."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Triangles = NDArray[np.int64]

_STL_HEAD, _STL_TRIANGLE = 84, 50  # bytes
_MOST_STL_TRIANGLES = 200_000  # that MuJoCo reads
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_TRANSFORMS = ("matrix", "translate", "rotate", "scale")


def convert_mesh(file: Path) -> bytes | None:
    """Return a file in MuJoCo's MSH format, or None if MuJoCo reads the file itself.

    Text of STL is recognized by its length, which does not fit its number of triangles. Raises `ValueError` for a
    damaged file.
    """
    suffix = file.suffix.lower()
    try:
        if suffix == ".dae":
            return write_msh(*read_collada(file))
        if suffix == ".stl" and not _is_binary_stl(file):
            return write_msh(*_read_stl_text(file))
        if suffix == ".stl" and file.stat().st_size > _STL_HEAD + _STL_TRIANGLE * _MOST_STL_TRIANGLES:
            return write_msh(*_read_stl(file))
    except (OSError, IndexError, KeyError, StopIteration, ElementTree.ParseError) as error:
        raise ValueError(f"{file}: {error}") from error
    return None


def read_mesh(file: Path) -> tuple[Array, Triangles]:
    """Return the points [m], shape (points, 3), and triangles, shape (triangles, 3), of an STL, OBJ or COLLADA file.

    Raises `ValueError` for another one or a damaged one.
    """
    readers = {".stl": _read_any_stl, ".obj": _read_obj, ".dae": read_collada}
    if (reader := readers.get(file.suffix.lower())) is None:
        raise ValueError(f"{file}: not an STL, OBJ or DAE file")
    try:
        return reader(file)
    except (OSError, IndexError, KeyError, ElementTree.ParseError) as error:
        raise ValueError(f"{file}: {error}") from error


def _read_any_stl(file: Path) -> tuple[Array, Triangles]:
    return (_read_stl if _is_binary_stl(file) else _read_stl_text)(file)


def _read_obj(file: Path) -> tuple[Array, Triangles]:
    lines = [line.split() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
    points = np.array([words[1:4] for words in lines if words[:1] == ["v"]], float).reshape(-1, 3)
    polygons = [[int(word.split("/")[0]) for word in words[1:]] for words in lines if words[:1] == ["f"]]
    corners = np.array([corner for polygon in polygons for corner in polygon], int)
    # Numbers count from 1, or backwards from the last point.
    corners = np.where(corners > 0, corners - 1, len(points) + corners)
    if not len(corners) or corners.min() < 0 or corners.max() >= len(points):
        raise ValueError(f"{file}: no triangles, or of points that it does not have")
    return points, _split_polygons(corners, np.array([len(polygon) for polygon in polygons]))


def count_vertices(file: Path) -> int:
    """Return the number of different vertices of an STL, OBJ or COLLADA file; raises `ValueError` for another one."""
    suffix = file.suffix.lower()
    if suffix == ".obj":
        return sum(line.startswith(b"v ") for line in file.read_bytes().splitlines())
    if suffix == ".stl":
        return len(_read_any_stl(file)[0])
    if suffix == ".dae":
        return len(np.unique(read_collada(file)[0], axis=0))
    raise ValueError(f"{file}: not an STL, OBJ or DAE file")


def write_msh(points: Array, triangles: Triangles) -> bytes:
    """Return a mesh in MuJoCo's MSH format; without triangles MuJoCo takes those of the convex hull."""
    counts = struct.pack("<4i", len(points), 0, 0, len(triangles))
    return counts + points.astype("<f4").tobytes() + triangles.astype("<i4").tobytes()


def _is_binary_stl(file: Path) -> bool:
    with file.open("rb") as opened:
        head = opened.read(_STL_HEAD)
    return (
        len(head) == _STL_HEAD and file.stat().st_size == _STL_HEAD + _STL_TRIANGLE * struct.unpack("<I", head[80:])[0]
    )


def _read_stl(file: Path) -> tuple[Array, Triangles]:
    row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return _join_corners(np.fromfile(file, row, offset=_STL_HEAD)["corners"].reshape(-1, 3).astype(float))


def _read_stl_text(file: Path) -> tuple[Array, Triangles]:
    lines = (line.split() for line in file.read_text(encoding="utf-8", errors="replace").splitlines())
    corners = np.array([words[1:4] for words in lines if words[:1] == ["vertex"]], float)
    if not len(corners) or len(corners) % 3:
        raise ValueError(f"{file}: neither a text nor a binary STL file")
    return _join_corners(corners)


def _join_corners(corners: Array) -> tuple[Array, Triangles]:
    points, numbers = np.unique(corners, axis=0, return_inverse=True)
    return points, numbers.reshape(-1, 3)


def read_collada(file: Path) -> tuple[Array, Triangles]:
    """Return the points of a COLLADA file [m], z up, shape (points, 3), and triangles of them, shape (triangles, 3).

    Nodes are placed where the file's scene has them. Raises `ValueError`, `KeyError` or `ParseError` for a damaged one.
    """
    root = ElementTree.parse(file).getroot()
    geometries = {part.get("id", ""): list(_read_geometry(part)) for part in root.iterfind(".//{*}geometry")}
    points: list[Array] = []
    triangles: list[Triangles] = []
    for matrix, name in _list_instances(root.find(".//{*}visual_scene"), _find_axes(root)):
        for part, corners in geometries.get(name, ()):
            triangles.append(corners + sum(map(len, points)))
            points.append(part @ matrix[:3, :3].T + matrix[:3, 3])
    if not triangles:
        raise ValueError(f"{file}: no triangles")
    return np.concatenate(points), np.concatenate(triangles)


def _find_axes(root: ElementTree.Element) -> Array:
    unit, up = root.find("{*}asset/{*}unit"), root.findtext("{*}asset/{*}up_axis", "Y_UP")
    matrix = np.eye(4)
    if up == "Y_UP":
        matrix[:3, :3] = _Y_UP
    matrix[:3] *= float(unit.get("meter", 1.0)) if unit is not None else 1.0
    return matrix


def _list_instances(node: ElementTree.Element | None, matrix: Array) -> Iterator[tuple[Array, str]]:
    """Yield the geometries below a node, and the matrices of shape (4, 4) that place them."""
    for child in node if node is not None else ():
        kind = child.tag.rpartition("}")[2]
        if kind == "node":
            yield from _list_instances(child, matrix)
        elif kind == "instance_geometry":
            yield matrix, child.get("url", "").lstrip("#")
        elif kind in _TRANSFORMS:
            matrix = matrix @ _make_matrix(kind, np.array((child.text or "").split(), float))


def _make_matrix(kind: str, numbers: Array) -> Array:
    if kind == "matrix":
        return numbers.reshape(4, 4)
    matrix = np.eye(4)
    if kind == "translate":
        matrix[:3, 3] = numbers
    elif kind == "scale":
        matrix[:3, :3] = np.diag(numbers)
    else:
        matrix[:3, :3] = _make_rotation(numbers[:3], float(np.radians(numbers[3])))
    return matrix


def _make_rotation(axis: Array, angle: float) -> Array:
    """Return a rotation matrix by Rodrigues' formula; `angle` [rad]."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return rotation


def _read_geometry(geometry: ElementTree.Element) -> Iterator[tuple[Array, Triangles]]:
    """Yield points of shape (points, 3) and triangles of shape (triangles, 3) of each part."""
    arrays = {
        source.get("id"): np.array(source.findtext("{*}float_array", "").split(), float)
        for source in geometry.iterfind("{*}mesh/{*}source")
    }
    positions = {
        vertices.get("id"): entry.get("source", "").lstrip("#")
        for vertices in geometry.iterfind("{*}mesh/{*}vertices")
        for entry in vertices.iterfind("{*}input")
        if entry.get("semantic") == "POSITION"
    }
    for kind in ("triangles", "polylist", "polygons"):
        for part in geometry.iterfind(f"{{*}}mesh/{{*}}{kind}"):
            inputs = part.findall("{*}input")
            width = 1 + max(int(entry.get("offset", 0)) for entry in inputs)
            vertex = next(entry for entry in inputs if entry.get("semantic") == "VERTEX")
            lists = [np.array((p.text or "").split(), int).reshape(-1, width) for p in part.iterfind("{*}p")]
            if not lists:
                continue
            corners = np.concatenate(lists)[:, int(vertex.get("offset", 0))]
            points = arrays[positions[vertex.get("source", "").lstrip("#")]].reshape(-1, 3)
            counts = {
                "triangles": [3] * (len(corners) // 3),
                "polylist": part.findtext("{*}vcount", "").split(),
                "polygons": [len(polygon) for polygon in lists],
            }[kind]
            yield points, _split_polygons(corners, np.array(counts, int))


def _split_polygons(corners: Triangles, counts: Triangles) -> Triangles:
    """Return the triangles of polygons with `counts` corners, as fans around each one's first corner."""
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    polygons = np.split(corners, np.cumsum(counts)[:-1])
    fans = [(polygon[0], *polygon[index : index + 2]) for polygon in polygons for index in range(1, len(polygon) - 1)]
    return np.array(fans, int).reshape(-1, 3)
