"""Mesh files that the Rerun viewer shows differently than PyBullet: COLLADA files, and OBJ files with a texture."""

import functools
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rlctl.replaying.mjcf import Mesh
from rlctl.task.meshes import read_collada


@functools.lru_cache(maxsize=64)  # of several episodes, and of links with the same file
def load_mesh(file: Path) -> Mesh | None:
    """Return the mesh of a file; None for a file that the viewer itself shows correctly, or that cannot be read."""
    try:
        if file.suffix.lower() == ".dae":
            return Mesh(*read_collada(file))
        return _read_textured_obj(file) if file.suffix.lower() == ".obj" else None
    except (OSError, UnicodeDecodeError, ValueError, IndexError, KeyError, AttributeError, ElementTree.ParseError):
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
