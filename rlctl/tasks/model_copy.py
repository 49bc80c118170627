"""Finds a user's robot model, and copies it with its meshes into one folder."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from rlctl.errors import TaskError, UsageError

_MESHES = Path("meshes")
_FILENAME = re.compile(r"""(\bfilename\s*=\s*)(["'])(.*?)\2""")


def find_own_model(model: str) -> Path:
    """Return the file of `--model`: a path, or one of rlctl's or PyBullet's models; raises `UsageError`."""
    from rlctl.task.model_files import explain_missing, find_model_file

    try:
        return find_model_file(model)
    except TaskError:
        raise UsageError(f"--model: {explain_missing(Path(model))}") from None


def copy_model(model: Path) -> dict[Path, bytes]:
    """Return the files of a model by their path in the copy: URDF or MJCF, and its meshes in `meshes/`.

    A URDF keeps its text except for the paths of meshes; an MJCF file and what it includes become one file.
    """
    files: dict[Path, bytes] = {}
    text = _copy_urdf(model, files) if model.suffix == ".urdf" else _copy_mjcf(model, files)
    files[Path(model.name)] = text
    return files


def _copy_urdf(model: Path, files: dict[Path, bytes]) -> bytes:
    from rlctl.task.mesh_paths import resolve_mesh

    copies: dict[Path, str] = {}

    def rename(match: re.Match[str]) -> str:
        before, quote, name = match.groups()
        source = resolve_mesh(name, model)
        if source is None:  # such as the library of a Gazebo plugin
            return match[0]
        if source not in copies:
            copies[source] = _add(files, source)
        return f"{before}{quote}{copies[source]}{quote}"

    # Byte for byte in Latin-1, whatever the encoding is.
    return _FILENAME.sub(rename, model.read_bytes().decode("latin-1")).encode("latin-1")


def _copy_mjcf(model: Path, files: dict[Path, bytes]) -> bytes:
    import mujoco

    spec = mujoco.MjSpec.from_file(str(model))
    folders = {"mesh": spec.meshdir, "hfield": spec.meshdir, "skin": spec.meshdir, "texture": spec.texturedir}
    root = ElementTree.fromstring(spec.to_xml())
    for asset in root.iterfind("asset/*[@file]"):
        name = asset.get("file", "")
        asset.set("name", asset.get("name", Path(name).stem))
        asset.set("file", Path(_add(files, model.parent / folders.get(asset.tag, "") / name)).name)
    for compiler in root.iterfind("compiler"):
        compiler.attrib.pop("assetdir", None)
        compiler.attrib |= {"meshdir": _MESHES.as_posix(), "texturedir": _MESHES.as_posix()}
    return ElementTree.tostring(root)


def _add(files: dict[Path, bytes], source: Path) -> str:
    """Add a file under a name of its own and return its path in the copy."""
    path, number = _MESHES / source.name, 1
    while path in files:
        number += 1
        path = _MESHES / f"{source.stem}-{number}{source.suffix}"
    try:
        files[path] = source.read_bytes()
    except OSError as error:
        raise UsageError(f"--model: {source}: {error.strerror or error}") from None
    return path.as_posix()


def remove_floor(files: dict[Path, bytes], model: Path) -> list[str]:
    """Remove shapes of the world, such as a floor, from the copy of an MJCF file; return a sentence if there were."""
    if model.suffix != ".xml":
        return []
    root = ElementTree.fromstring(files[model])
    removed = 0
    for world in root.iterfind("worldbody"):
        for geom in world.findall("geom"):
            world.remove(geom)
            removed += 1
    if not removed:
        return []
    files[model] = ElementTree.tostring(root)
    return [f"The copy of {model.name} has no floor, since the task loads one"]
