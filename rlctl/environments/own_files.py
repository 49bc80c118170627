"""The files that a task is made of, found without an import: its source, what that imports of its own package or
folder, and the model files that these name."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

from rlctl.storage import files

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf", ".xacro", ".sdf", ".obj", ".stl", ".dae", ".npz", ".npy", ".csv", ".yaml")
_MOST_FILES = 300
_LONGEST_NAME = 200  # of a file; the rest is prose
_LARGEST = 2**25  # bytes of a file whose content is compared
_TARGET = re.compile(r"([A-Za-z_][\w.]*):[A-Za-z_][\w.]*")
_NAMED_FILE = re.compile(r"""\b(?:file|filename)\s*=\s*["']([^"'<>]+)["']""")
_NAMED_FOLDER = re.compile(r"""\b(?:meshdir|assetdir|texturedir)\s*=\s*["']([^"'<>]+)["']""")


def digest_own_files(source: Path | None) -> dict[str, str]:
    """Return the SHA-256 of the files that a source needs besides itself, by their paths below its package's folder
    (its own folder, if it is in no package)."""
    if source is None or not source.is_file():
        return {}
    top = _find_top(source)
    states = {file: file.stat() for file in sorted(_follow(source.resolve(), top))}
    return {
        file.relative_to(top).as_posix(): _digest(file, state.st_mtime_ns, state.st_size)
        for file, state in states.items()
        if state.st_size <= _LARGEST
    }


@functools.lru_cache(maxsize=1024)
def _digest(file: Path, _changed: int, _size: int) -> str:
    """Return the SHA-256 of a file, which a list of many runs asks for again and again."""
    return files.digest(file.read_bytes())


def _find_top(source: Path) -> Path:
    """Return the folder above the outermost package of a file."""
    folder = source.resolve().parent
    while (folder / "__init__.py").is_file():
        folder = folder.parent
    return folder


def _follow(source: Path, top: Path) -> set[Path]:
    """Return the files that a source needs, directly or not, without the source itself."""
    found, waiting = {source}, [source]
    while waiting and len(found) < _MOST_FILES:
        state = (file := waiting.pop()).stat()
        for needed in _list_needed(file, top, state.st_mtime_ns, state.st_size):
            if needed not in found and needed.is_file():
                found.add(needed)
                waiting.append(needed)
    return found - {source}


@functools.lru_cache(maxsize=1024)
def _list_needed(file: Path, top: Path, _changed: int, size: int) -> tuple[Path, ...]:
    """Return the files that a file names; the last two arguments tell a file from what it was before."""
    if size > _LARGEST or file.suffix not in (".py", *MODEL_SUFFIXES[:5]):
        return ()
    try:
        text = file.read_text()
        named = _list_of_source(ast.parse(text), file, top) if file.suffix == ".py" else _list_of_model(text, file)
        return tuple(path.resolve() for path in named if path.is_file() and path.resolve().is_relative_to(top))
    except (IndexError, OSError, ValueError, SyntaxError, RecursionError):  # an index: `from .....` above all folders
        return ()


def _list_of_source(tree: ast.AST, file: Path, top: Path) -> Iterator[Path]:
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                for one in names:
                    yield from _list_places(top, one.name)
            case ast.ImportFrom(module=module, names=names, level=level):
                start = file.parents[level - 1] if level else top
                for one in names:  # a module, or a name that a module defines
                    modules = list(_list_places(start, f"{module or ''}.{one.name}".strip(".")))
                    yield from modules or (_list_places(start, module) if module else ())
            case ast.Constant(value=str(text)) if text.endswith(MODEL_SUFFIXES) and len(text) <= _LONGEST_NAME:
                yield from _find_model(text, file, top)
            case ast.Constant(value=str(text)) if target := _TARGET.fullmatch(text):
                yield from _list_places(top, target[1])


def _list_places(start: Path, module: str) -> Iterator[Path]:
    """Yield the file of a module below a folder, if it is there."""
    place = start.joinpath(*module.split("."))
    yield from (file for file in (place.with_name(f"{place.name}.py"), place / "__init__.py") if file.is_file())


def _find_model(name: str, file: Path, top: Path) -> Iterator[Path]:
    """Yield the files that a text in a source may name: next to it, or anywhere in its package."""
    beside = file.parent / name
    package = top / file.relative_to(top).parts[0]
    if beside.is_file():
        yield beside
    elif package.is_dir():
        yield from (one for one in package.rglob(Path(name).name) if one.as_posix().endswith(f"/{name.lstrip('./')}"))


def _list_of_model(text: str, file: Path) -> Iterator[Path]:
    folders = [file.parent, *(file.parent / folder for folder in _NAMED_FOLDER.findall(text))]
    for name in _NAMED_FILE.findall(text):
        yield from (folder / re.sub(r"^package://[^/]+/", "", name) for folder in folders)
