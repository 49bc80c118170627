"""Finds a user's robot model, and copies it with its meshes into one folder."""

import html
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.sax import saxutils

from rlctl.errors import TaskError, UsageError

_MESHES = Path("meshes")
_FILENAME = re.compile(r"""(<(?:mesh|texture)\b[^<>]*?\bfilename\s*=\s*)(["'])(.*?)\2""", re.DOTALL)
_SUFFIXES = {".stl", ".obj", ".dae", ".msh", ".ply", ".skn", ".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff"}
"""Of meshes and pictures: no other file is copied, whatever a model names."""
_FOLDERS_OF_MODELS = {"urdf", "urdfs", "xml", "mjcf", "robots", "model", "models"}
_MOST_NAMES = 4


def find_own_model(model: str) -> Path:
    """Return the file of `--model`: a path, or one of rlctl's or PyBullet's models; raises `UsageError`."""
    from rlctl.task.model_files import explain_missing, find_model_file

    try:
        return find_model_file(model)
    except TaskError:
        raise UsageError(f"--model: {explain_missing(Path(model))}") from None


def copy_model(model: Path) -> dict[Path, bytes]:
    """Return the files of a model by their path in the copy: URDF or MJCF, and its meshes in `meshes/`.

    A URDF keeps its text except for the paths of meshes; an MJCF file and what it includes become one file. Only meshes
    and pictures are copied. Raises `UsageError` for others, and for those outside the model's folder without consent.
    """
    files: dict[Path, bytes] = {}
    sources: dict[Path, str] = {}  # files to copy, and their paths in the copy
    text = _copy_urdf(model, sources) if model.suffix == ".urdf" else _copy_mjcf(model, sources)
    _ask_about(model, [source for source in sources if not source.resolve().is_relative_to(_find_folder(model))])
    for source, path in sources.items():
        try:
            files[Path(path)] = source.read_bytes()
        except OSError as error:
            raise UsageError(f"--model: {source}: {error.strerror or error}") from None
    files[Path(model.name)] = text
    return files


def _find_folder(model: Path) -> Path:
    """Return the folder that belongs to a model: that of its ROS package, or the one that its folder `urdf` is in."""
    folder = model.resolve().parent
    package = next((above for above in (folder, *folder.parents) if (above / "package.xml").is_file()), None)
    if package is not None:
        return package
    return folder.parent if folder.name.lower() in _FOLDERS_OF_MODELS else folder


def _ask_about(model: Path, outside: list[Path]) -> None:
    """Ask whether files outside a model's folder are to be copied; raises `UsageError` if not."""
    from rlctl import output

    if not outside:
        return
    more = f" and {len(outside) - _MOST_NAMES} more" if len(outside) > _MOST_NAMES else ""
    shown = ", ".join(map(str, outside[:_MOST_NAMES])) + more
    named = f"--model: {model.name} names files outside its folder {_find_folder(model)}: {shown}"
    refusal = f"{named}; copy them into it first, or answer on a terminal"
    if not output.confirm(f"{named}\nCopy them into the plugin?", refusal):
        raise UsageError(f"{named}; nothing was written")


def _copy_urdf(model: Path, sources: dict[Path, str]) -> bytes:
    from rlctl.task.mesh_paths import resolve_mesh
    from rlctl.task.urdf import find_encoding

    def rename(match: re.Match[str]) -> str:
        before, quote, name = match.groups()
        source = resolve_mesh(html.unescape(name), model)
        if source is None:  # a visual mesh that is missing
            return match[0]
        path = saxutils.escape(_add(sources, source, model), {'"': "&quot;", "'": "&apos;"})
        return f"{before}{quote}{path}{quote}"

    data = model.read_bytes()
    encoding = find_encoding(data)
    return _FILENAME.sub(rename, data.decode(encoding)).encode(encoding, errors="xmlcharrefreplace")


def _copy_mjcf(model: Path, sources: dict[Path, str]) -> bytes:
    import mujoco

    spec = mujoco.MjSpec.from_file(str(model))
    folders = {"mesh": spec.meshdir, "hfield": spec.meshdir, "skin": spec.meshdir, "texture": spec.texturedir}
    try:
        root = ElementTree.fromstring(spec.to_xml())
    except ValueError as error:  # a mesh is missing
        raise UsageError(f"--model: MuJoCo cannot load {model}: {' '.join(str(error).split())}") from None
    for asset in root.iterfind("asset/*[@file]"):
        name = asset.get("file", "")
        asset.set("name", asset.get("name", Path(name).stem))
        source = model.parent / folders.get(asset.tag, "") / name
        asset.set("file", Path(_add(sources, source, model)).name)
    for compiler in root.iterfind("compiler"):
        compiler.attrib.pop("assetdir", None)
        compiler.attrib |= {"meshdir": _MESHES.as_posix(), "texturedir": _MESHES.as_posix()}
    return ElementTree.tostring(root)


def _add(sources: dict[Path, str], source: Path, model: Path) -> str:
    """Add a file that is to be copied, under a name of its own, and return its path in the copy."""
    if source in sources:
        return sources[source]
    if source.suffix.lower() not in _SUFFIXES:
        raise UsageError(
            f"--model: {model.name} names {source} as a mesh or a texture: no file of a kind that is copied"
        )
    path, number = _MESHES / source.name, 1
    while path.as_posix() in sources.values():
        number += 1
        path = _MESHES / f"{source.stem}-{number}{source.suffix}"
    sources[source] = path.as_posix()
    return sources[source]


def remove_floor(files: dict[Path, bytes], model: Path) -> list[str]:
    """Remove shapes of the world, such as a floor, from the copy of an MJCF file; return a sentence if there were."""
    if _remove(files, model, "worldbody", "geom"):
        return [f"The copy of {model.name} has no floor, since the task loads one"]
    return []


def remove_sensors(files: dict[Path, bytes], model: Path) -> list[str]:
    """Remove the sensors from the copy of an MJCF file; return a sentence if there were."""
    if _remove(files, model, "sensor", "*"):
        return [f"The copy of {model.name} has no sensors: the task reads none, and they take time in every step"]
    return []


def _remove(files: dict[Path, bytes], model: Path, section: str, kind: str) -> bool:
    """Remove the elements of a kind in the sections of the copy of an MJCF file; return whether there were any."""
    if model.suffix != ".xml":
        return False
    root = ElementTree.fromstring(files[model])
    removed = False
    for parent in root.iterfind(section):
        for element in parent.findall(kind):
            parent.remove(element)
            removed = True
    if removed:
        files[model] = ElementTree.tostring(root)
    return removed
