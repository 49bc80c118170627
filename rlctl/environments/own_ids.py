"""Finds what registers a Gymnasium id, and the file of its class, in the text of packages: nothing is imported."""

import ast
import contextlib
import itertools
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from rlctl.entry_points import find_module_file

_MOST_FILES = 400  # of the current folder, and of each installed package
_DEEPEST = 4  # folders below the current one
_FORMATTED_ID = re.compile(rb"""f["']([^"'\n]*\{[^"'\n]*)["']""")
_LEAST_NAME = 4  # letters of a formatted id, so that `f"{name}-v0"` is not any id


def find_registering_module(name: str) -> str:
    """Return the module to write before an id, `module:Id-v0`; empty if none is found, or one is named already."""
    return "" if ":" in name else next(_list_modules(name), "")


def find_class_file(name: str) -> Path | None:
    """Return the file of the class of `module:Id-v0`; None where the module does not register the id with literals."""
    module, _, identifier = name.rpartition(":")
    file = find_module_file(module, in_current_folder=True) if module else None
    nodes: list[ast.AST] = []
    with contextlib.suppress(OSError, SyntaxError, ValueError):
        nodes = list(ast.walk(ast.parse(file.read_bytes()))) if file else []
    own_classes = {node.name for node in nodes if isinstance(node, ast.ClassDef)}
    for call in (node for node in nodes if isinstance(node, ast.Call)):
        given = dict(zip(("id", "entry_point"), call.args, strict=False))
        given |= {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg is not None}
        match given.get("id"), given.get("entry_point"):
            case ast.Constant(value=registered), ast.Constant(value=str(place)) if registered == identifier:
                return find_module_file(place.partition(":")[0], in_current_folder=True)
            case ast.Constant(value=registered), ast.Name(id=own) if registered == identifier and own in own_classes:
                return file
    return None


def _list_modules(name: str) -> Iterator[str]:
    """Yield the modules whose text has the id in quotes and that can be imported, first those of the current folder."""
    is_registered = _Registering(name)
    here = Path()
    depths = (here.glob("/".join(["*"] * depth + ["*.py"])) for depth in range(_DEEPEST))
    for file in itertools.islice(itertools.chain.from_iterable(depths), _MOST_FILES):
        if is_registered.in_file(file) and (module := _name_module(file)):
            yield module
    for package, folder in _list_packages():
        if any(is_registered.in_file(file) for file in itertools.islice(folder.rglob("*.py"), _MOST_FILES)):
            yield package


def _name_module(file: Path) -> str:
    """Return the name by which Python finds a file below the current folder: that of an installed package, whose folder
    may be `src`, before the path from here; empty if there is none."""
    parts = file.parent.parts if file.name == "__init__.py" else file.with_suffix("").parts
    for start in range(len(parts)):
        name = ".".join(parts[start:])
        if (found := find_module_file(name)) is not None and found.resolve() == file.resolve():
            return name
    name = ".".join(parts)
    return name if parts and find_module_file(name, in_current_folder=True) is not None else ""


class _Registering:
    """Whether the text of a file registers an id: in quotes, or as `f"Fetch{reward}-v4"`, which the id fits."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._quoted = re.compile(rf"""["']{re.escape(name)}["']""".encode())

    def in_file(self, file: Path) -> bool:
        """Return whether a file does; False if it cannot be read."""
        with contextlib.suppress(OSError):
            text = file.read_bytes()
            return b"register" in text and (self._quoted.search(text) is not None or self._has_pattern(text))
        return False

    def _has_pattern(self, text: bytes) -> bool:
        for match in _FORMATTED_ID.finditer(text):
            parts = re.split(r"\{[^{}]*\}", match[1].decode(errors="replace"))
            letters = max(len(re.sub(r"-v\d*$", "", part)) for part in parts)
            form = r"[\w.-]*".join(map(re.escape, parts))
            if letters >= _LEAST_NAME and re.fullmatch(form, self._name) is not None:
                return True
        return False


def _list_packages() -> Iterator[tuple[str, Path]]:
    """Yield the packages of all distributions that need Gymnasium or the old gym, and their folders."""
    for distribution in metadata.distributions():
        if not any(re.match(r"gym(nasium)?\b", requirement) for requirement in distribution.requires or ()):
            continue
        for package in (distribution.read_text("top_level.txt") or distribution.metadata["Name"] or "").split():
            file = find_module_file(package.replace("-", "_"))
            if file is not None and file.name == "__init__.py":
                yield package.replace("-", "_"), file.parent
