"""Mesh files that the Rerun viewer shows differently than PyBullet: COLLADA files, and OBJ files with a texture."""

import functools
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from rlctl.replaying.mjcf import Mesh
from rlctl.replaying.rotations import from_axis, rotate

Array = NDArray[np.float64]


@functools.lru_cache(maxsize=64)  # of several episodes, and of links with the same file
def load_mesh(file: Path) -> Mesh | None:
    """Return the mesh of a file; None for a file that the viewer itself shows correctly, or that cannot be read."""
    try:
        if file.suffix.lower() == ".dae":
            return _read_collada(file)
        return _read_textured_obj(file) if file.suffix.lower() == ".obj" else None
    except (OSError, UnicodeDecodeError, ValueError, IndexError, AttributeError, ElementTree.ParseError):
        return None


def _read_textured_obj(file: Path) -> Mesh | None:
    lines = [line.split() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
    texture = next(
        (found for words in lines if words[:1] == ["mtllib"] and (found := _find_texture(file, words))), None
    )
    if texture is None:
        return None
    points = np.array([words[1:4] for words in lines if words[:1] == ["v"]], np.float64)
    coordinates = np.array([words[1:3] for words in lines if words[:1] == ["vt"]], np.float64).reshape(-1, 2)
    corners: dict[tuple[int, int], int] = {}  # a point and a texture coordinate
    triangles = []
    for words in lines:
        if words[:1] == ["f"]:
            face = [_read_corner(word, len(points), len(coordinates)) for word in words[1:]]
            numbers = [corners.setdefault(corner, len(corners)) for corner in face]
            triangles += [(numbers[0], *numbers[index : index + 2]) for index in range(1, len(numbers) - 1)]
    used = np.array(list(corners))
    uvs = coordinates[used[:, 1]] * (1.0, -1.0) + (0.0, 1.0)  # OBJ counts from the lower edge of the picture
    return Mesh(points[used[:, 0]], np.array(triangles), uvs, texture)


def _read_corner(word: str, points: int, coordinates: int) -> tuple[int, int]:
    """Read `3/1/2`: numbers from 1, or negative ones from the last; raises `ValueError` without texture coordinate."""
    point, coordinate = (int(number) for number in word.split("/")[:2])
    return point - 1 if point > 0 else points + point, coordinate - 1 if coordinate > 0 else coordinates + coordinate


def _find_texture(file: Path, words: list[str]) -> Path | None:
    library = file.parent / " ".join(words[1:])
    if not library.is_file():
        return None
    for line in library.read_text(encoding="utf-8", errors="replace").splitlines():
        name, _, picture = line.strip().partition(" ")
        path = file.parent / picture.strip().replace("\\", "/")
        if name == "map_Kd" and path.is_file():
            return path
    return None


def _read_collada(file: Path) -> Mesh:
    root = ElementTree.parse(file).getroot()
    geometries = {part.get("id", ""): list(_read_geometry(part)) for part in root.iterfind(".//{*}geometry")}
    vertices: list[Array] = []
    triangles: list[NDArray[np.int64]] = []
    for matrix, name in _list_instances(root.find(".//{*}visual_scene"), _find_axes(root)):
        for points, corners in geometries.get(name, ()):
            triangles.append(corners + sum(map(len, vertices)))
            vertices.append(points @ matrix[:3, :3].T + matrix[:3, 3])
    return Mesh(np.concatenate(vertices), np.concatenate(triangles))


def _find_axes(root: ElementTree.Element) -> Array:
    unit, up = root.find("{*}asset/{*}unit"), root.findtext("{*}asset/{*}up_axis", "Y_UP")
    matrix = np.eye(4)
    if up == "Y_UP":
        matrix[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    matrix[:3] *= float(unit.get("meter", 1.0)) if unit is not None else 1.0
    return matrix


def _list_instances(node: ElementTree.Element | None, matrix: Array) -> Iterator[tuple[Array, str]]:
    """Yield the geometries below a node, and the matrices of shape (4, 4) that place them."""
    for child in node if node is not None else ():
        kind = child.tag.rpartition("}")[2]
        numbers = np.array((child.text or "").split(), np.float64) if kind in _TRANSFORMS else np.zeros(0)
        if kind == "node":
            yield from _list_instances(child, matrix)
        elif kind == "instance_geometry":
            yield matrix, child.get("url", "").lstrip("#")
        elif kind in _TRANSFORMS:
            matrix = matrix @ _make_matrix(kind, numbers)


_TRANSFORMS = ("matrix", "translate", "rotate", "scale")


def _make_matrix(kind: str, numbers: Array) -> Array:
    matrix = np.eye(4)
    if kind == "matrix":
        return numbers.reshape(4, 4)
    if kind == "translate":
        matrix[:3, 3] = numbers
    elif kind == "scale":
        matrix[:3, :3] = np.diag(numbers)
    else:
        matrix[:3, :3] = rotate(from_axis(numbers[:3], np.radians(numbers[3])), np.eye(3)).T
    return matrix


def _read_geometry(geometry: ElementTree.Element) -> Iterator[tuple[Array, NDArray[np.int64]]]:
    """Yield points of shape (points, 3) and triangles of shape (triangles, 3) of each part."""
    arrays = {
        source.get("id"): np.array(source.findtext("{*}float_array", "").split(), np.float64)
        for source in geometry.iterfind("{*}mesh/{*}source")
    }
    positions = {
        vertices.get("id"): entry.get("source", "").lstrip("#")
        for vertices in geometry.iterfind("{*}mesh/{*}vertices")
        for entry in vertices.iterfind("{*}input")
        if entry.get("semantic") == "POSITION"
    }
    for kind in ("triangles", "polylist"):
        for part in geometry.iterfind(f"{{*}}mesh/{{*}}{kind}"):
            inputs = part.findall("{*}input")
            width = 1 + max(int(entry.get("offset", 0)) for entry in inputs)
            vertex = next(entry for entry in inputs if entry.get("semantic") == "VERTEX")
            numbers = np.array(part.findtext("{*}p", "").split(), np.int64).reshape(-1, width)
            corners = numbers[:, int(vertex.get("offset", 0))]
            counts = np.array(part.findtext("{*}vcount", "").split(), np.int64)
            points = arrays[positions[vertex.get("source", "").lstrip("#")]].reshape(-1, 3)
            yield points, corners.reshape(-1, 3) if kind == "triangles" else _split_polygons(corners, counts)


def _split_polygons(corners: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    polygons = np.split(corners, np.cumsum(counts)[:-1])
    fans = [(polygon[0], *polygon[index : index + 2]) for polygon in polygons for index in range(1, len(polygon) - 1)]
    return np.array(fans, np.int64).reshape(-1, 3)
