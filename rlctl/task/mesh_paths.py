"""Finds the files that a URDF names: `package://NAME/...` of ROS, `file://`, and paths relative to the URDF."""

import glob
import os
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

_PACKAGE = ("package://", "model://")
_FILE = "file://"


def has_scheme(name: str) -> bool:
    """Return whether a name of a mesh is an address rather than a path."""
    return name.startswith((*_PACKAGE, _FILE))


def resolve_mesh(name: str, urdf: Path) -> Path | None:
    """Return the absolute path of a mesh or texture that a URDF file names; None if there is no such file.

    A package is a folder of that name above the file or next to one above it, in `ROS_PACKAGE_PATH` or a folder
    there, or in `share` of `AMENT_PREFIX_PATH`. A relative path begins at the URDF, or at a folder above it.
    """
    above = list(urdf.absolute().parents)
    if name.startswith(_PACKAGE):
        candidates = _list_package_files(name.partition("://")[2], above)
    else:
        path = unquote(name.removeprefix(_FILE)) if name.startswith(_FILE) else name
        candidates = (folder / path for folder in above)
    return next((path for path in candidates if path.is_file()), None)


def _list_package_files(name: str, above: list[Path]) -> Iterator[Path]:
    package, _, rest = name.partition("/")
    for folder in above:
        if folder.name == package:
            yield folder / rest
        yield folder / name
    for folder in _read_folders("ROS_PACKAGE_PATH"):
        if folder.name == package:
            yield folder / rest
        yield folder / name
        yield from sorted(folder.glob(f"*/{glob.escape(name)}")) if rest else ()
    yield from (folder / "share" / name for folder in _read_folders("AMENT_PREFIX_PATH"))
    yield from (folder / rest for folder in above)  # the package's folder has another name


def _read_folders(variable: str) -> list[Path]:
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
