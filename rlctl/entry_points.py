"""What installed distributions add to rlctl, by the entry points of a group: tasks, commands. Imports no plugin."""

import ast
import contextlib
import dataclasses
import functools
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from rlctl.errors import short_repr

OURS = ("rlctl", "rlctl-core")
"""The distributions of rlctl itself, whose names win over those of others."""

_NAME = re.compile(r"\w[\w.-]{,99}")
_TARGET = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


@dataclasses.dataclass(frozen=True)
class EntryPoint:
    """What a distribution adds under a name, as it declares it; its code is not imported."""

    what: ClassVar[str]  # "task"
    form: ClassVar[str]  # of its target: `package.module:Class`

    name: str
    target: str
    distribution: str
    version: str
    problem: str | None = None  # why it cannot be used by its name; None if it can

    @property
    def module(self) -> str:
        """The name of the module in which it is defined."""
        return self.target.partition(":")[0]

    @property
    def module_file(self) -> Path | None:
        """The module's file, found without importing it or its packages."""
        return find_module_file(self.module)

    @property
    def summary(self) -> str:
        """The first line of its docstring, or of its module's; read from the source, as an import may take seconds."""
        file = self.module_file
        summaries = _read_summaries(file) if file else {}
        return summaries.get(self.target.partition(":")[2], "")

    def describe_taken(self, owner: str) -> str:
        """Return the problem of a name that `owner` has."""
        return f"name taken by {owner}"


_Kind = TypeVar("_Kind", bound=EntryPoint)


def list_entry_points(group: str, kind: type[_Kind]) -> list[_Kind]:
    """Return all entry points of a group, sorted by name. Of two with the same name, rlctl's own or the first is used.

    The result is cached until `sys.path` or a folder on it changes.
    """
    path = tuple((folder, _find_state(folder or os.curdir)) for folder in sys.path)
    declared: list[_Kind] = _list_entry_points(path, group, kind)  # type: ignore[arg-type] # a class is hashable
    return list(declared)


def _find_state(folder: str) -> tuple[int, ...]:
    try:
        state = os.stat(folder)
    except OSError:
        return ()
    return state.st_dev, state.st_ino, state.st_mtime_ns


_Path = tuple[tuple[str, tuple[int, ...]], ...]


@functools.lru_cache(maxsize=8)
def _list_entry_points(path: _Path, group: str, kind: Any) -> list[Any]:
    # A checkout on sys.path may declare the same names as its own installation: the first one is used.
    declared: dict[tuple[str, str], EntryPoint] = {}
    for origin in _list_origins(path):
        for entry in origin.read(group, kind):
            declared.setdefault((entry.name, entry.target), entry)
    entries: list[EntryPoint] = []
    owners: dict[str, EntryPoint] = {}
    for entry in sorted(declared.values(), key=_rank):
        owner = owners.setdefault(entry.name, entry)
        entries.append(dataclasses.replace(entry, problem=entry.problem or _find_problem(entry, owner)))
    return entries


def _rank(entry: EntryPoint) -> tuple[Any, ...]:
    return entry.name, entry.problem is not None, entry.distribution not in OURS, entry.distribution


def _find_problem(entry: EntryPoint, owner: EntryPoint) -> str | None:
    if entry is not owner:
        return entry.describe_taken(owner.distribution)
    if entry.module_file is None:
        return f"module {entry.module!r} is missing"
    return None


@dataclasses.dataclass(frozen=True)
class _Origin:
    """The metadata of a distribution that adds something to rlctl."""

    folder: Path  # NAME-VERSION.dist-info
    text: str  # of its entry_points.txt
    problem: str | None

    def read(self, group: str, kind: type[_Kind]) -> Iterator[_Kind]:
        """Yield what it declares in a group; what is broken in the distribution becomes the `problem` of each."""
        lines = list(_list_lines(self.text, group))
        names = self._read_names() if lines else ("?", "?")
        for line in lines:
            name, _, target = (part.strip() for part in line.partition("="))
            yield kind(short_repr(name, 100), target, *names, self.problem or _find_mistake(name, target, kind))

    def _read_names(self) -> tuple[str, str]:
        """Return name and version of the distribution, each `?` if its metadata has none."""
        found = {"Name": "?", "Version": "?"}
        for file in ("METADATA", "PKG-INFO"):
            with contextlib.suppress(OSError, UnicodeDecodeError):
                header = (self.folder / file).read_text(encoding="utf-8").partition("\n\n")[0]
                found |= dict(re.findall(r"^(Name|Version):[ \t]*(\S+)", header, re.MULTILINE))
                break
        return found["Name"], found["Version"]


@functools.lru_cache(maxsize=4)
def _list_origins(path: _Path) -> list[_Origin]:
    """Read the files themselves: `importlib.metadata` would take longer to import than `rlctl --help` has."""
    origins = []
    for folder, _ in path:
        for metadata in _list_metadata(folder or os.curdir):
            problem = None
            try:
                content = Path(metadata, "entry_points.txt").read_bytes()
            except OSError:  # most distributions have none
                continue
            if b"rlctl." not in content:
                continue
            try:
                text = content.decode()
            except UnicodeDecodeError:
                text = content.decode(errors="replace")
                problem = "its entry_points.txt is not UTF-8"
            origins.append(_Origin(Path(metadata), text, problem))
    return origins


def _list_metadata(folder: str) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.path for entry in entries if entry.name.endswith((".dist-info", ".egg-info")))
    except OSError:  # a folder that does not exist, or a zip file
        return []


def _list_lines(text: str, group: str) -> Iterator[str]:
    section = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            section = line.strip("[] ")
        elif line and section == group and not line.startswith(("#", ";")):
            yield line


def _find_mistake(name: str, target: str, kind: type[EntryPoint]) -> str | None:
    if not target:
        return f"its entry-point line is not NAME = {kind.form}"
    if not _NAME.fullmatch(name):
        return f"a {kind.what}'s name has 1 to 100 letters, digits, _, - and ."
    if not _TARGET.fullmatch(target):
        return f"its target {short_repr(target)!r} is not {kind.form}"
    return None


@functools.cache
def _read_summaries(file: Path) -> dict[str, str]:
    """Return the first line of the docstring of what a module defines: of each name, or else of the module."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError):
        return {}
    summaries = {}
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            summaries[node.name] = _read_first_line(node)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [target.id for target in targets if isinstance(target, ast.Name)]
            summaries |= dict.fromkeys(names, _read_first_line(tree))
    return summaries


def _read_first_line(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> str:
    return (ast.get_docstring(node) or "").partition("\n")[0]


def find_module_file(module: str, *, in_current_folder: bool = False) -> Path | None:
    """Find a module's file; unlike `find_spec` on a dotted name this imports no parent package.

    `in_current_folder` looks there as well, after all folders of `sys.path`.
    """
    head, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(head)
        if spec is None and in_current_folder:
            spec = PathFinder.find_spec(head, [os.getcwd()])
        for depth, _ in enumerate(rest, start=2):
            if spec is None:
                return None
            name = ".".join(module.split(".")[:depth])
            spec = _find_submodule(name, spec.submodule_search_locations)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin and spec.has_location else None


def _find_submodule(name: str, path: Sequence[str] | None) -> ModuleSpec | None:
    for finder in sys.meta_path:
        if not hasattr(finder, "find_spec"):
            continue
        try:
            spec = finder.find_spec(name, path)
        except KeyError:  # a folder without `__init__.py`: Python looks its parent up in `sys.modules`
            spec = PathFinder.find_spec(name.rpartition(".")[2], path)
        if spec is not None:
            return spec
    return None


def call_in_child(module: str, function: str, argument: str, timeout_s: float = 60.0) -> str | None:
    """Call a function of rlctl in a child process, because a plugin that it imports can end or hang the process.

    Return the `RlctlError` that it raises, or how the process ended, as one line; None if it returns.
    """
    import subprocess

    code = (
        f"from {module} import {function}; from rlctl.errors import RlctlError\n"
        f"try: {function}({argument!r})\n"
        "except RlctlError as error: print('\\n@' + str(error).splitlines()[0])\n"
        "else: print('\\n@')"
    )
    command = [sys.executable, "-P", "-c", code]
    try:
        child = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s, errors="replace"
        )
    except subprocess.TimeoutExpired:
        return f"import did not finish within {timeout_s:.0f} s"
    lines = [line[1:] for line in child.stdout.splitlines() if line.startswith("@")]
    return (lines[-1] or None) if lines else f"import ended the process with exit code {child.returncode}"
