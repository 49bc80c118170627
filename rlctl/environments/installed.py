"""Installed tasks: the entry points of the group `rlctl.tasks` in all distributions. Imports no plugin."""

import dataclasses
import functools
import importlib.metadata
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from rlctl.errors import describe_exception, short_repr

GROUP = "rlctl.tasks"
OURS = "rlctl"

_NAME = re.compile(r"\w[\w.-]{,99}")
_TARGET = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """An installed task, as its distribution declares it; its code is not imported."""

    name: str
    target: str  # `package.module:Class`
    distribution: str
    version: str
    problem: str | None = None  # why the task cannot be used by its name; None if it can

    @property
    def module_file(self) -> Path | None:
        """The module's file, found without importing it or its packages."""
        return find_module_file(self.target.partition(":")[0])

    @property
    def recipe_file(self) -> Path | None:
        """The packaged recipe: `<name>.yaml` next to the module, or the module's own, `<module>.yaml`."""
        file = self.module_file
        if file is None or self.problem:
            return None
        recipes = (file.with_name(f"{self.name}.yaml"), file.with_suffix(".yaml"))
        return next((recipe for recipe in recipes if recipe.is_file()), None)

    @property
    def policy_file(self) -> Path | None:
        """The shipped policy: `policies/<name>.safetensors` next to the module."""
        file = self.module_file
        if file is None or self.problem:
            return None
        policy = file.parent / "policies" / f"{self.name}.safetensors"
        return policy if policy.is_file() else None


def list_installed() -> list[TaskEntry]:
    """Return every installed task, sorted by name. Of two with the same name, rlctl's own or the first can be used.

    The result is cached until `sys.path` or a folder on it changes.
    """
    return list(_list_installed(tuple((folder, _find_state(folder or os.curdir)) for folder in sys.path)))


def find(name: str) -> TaskEntry | None:
    """Return the installed task with this name, or None."""
    if ":" in name:  # names a module, a file or a package
        return None
    return next((entry for entry in list_installed() if entry.name == name), None)


def _find_state(folder: str) -> tuple[int, ...]:
    try:
        state = os.stat(folder)
    except OSError:
        return ()
    return state.st_dev, state.st_ino, state.st_mtime_ns


@functools.lru_cache(maxsize=4)
def _list_installed(path: tuple[tuple[str, tuple[int, ...]], ...]) -> list[TaskEntry]:
    # A checkout on sys.path may declare the same tasks as its own installation: the first one is used.
    declared: dict[tuple[str, str], TaskEntry] = {}
    for distribution in importlib.metadata.distributions():
        for entry in _read_distribution(distribution):
            declared.setdefault((entry.name, entry.target), entry)
    entries: list[TaskEntry] = []
    owners: dict[str, TaskEntry] = {}
    for entry in sorted(declared.values(), key=_rank):
        owner = owners.setdefault(entry.name, entry)
        entries.append(dataclasses.replace(entry, problem=entry.problem or _find_problem(entry, owner)))
    return entries


def _rank(entry: TaskEntry) -> tuple[Any, ...]:
    return entry.name, entry.problem is not None, entry.distribution != OURS, entry.distribution


def _read_distribution(distribution: importlib.metadata.Distribution) -> Iterator[TaskEntry]:
    """Yield the tasks of a distribution; what is broken in it becomes the `problem` of its tasks."""
    problem = None
    try:
        text = distribution.read_text("entry_points.txt") or ""
    except UnicodeDecodeError as error:
        text = error.object.decode(errors="replace")
        problem = "its entry_points.txt is not UTF-8"
    except OSError:
        return
    if GROUP not in text:  # most distributions; their metadata is slow to parse and not needed
        return
    try:
        metadata: Any = distribution.metadata
        origin = (metadata["Name"] or "?", metadata["Version"] or "?")
    except Exception as error:  # a parser's own exceptions, where METADATA is missing or damaged
        origin = ("?", "?")
        problem = problem or f"its METADATA cannot be read: {describe_exception(error)}"
    for line in _list_lines(text):
        name, _, target = (part.strip() for part in line.partition("="))
        yield TaskEntry(short_repr(name, 100), target, *origin, problem or _find_mistake(name, target))


def _list_lines(text: str) -> Iterator[str]:
    section = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            section = line.strip("[] ")
        elif line and section == GROUP and not line.startswith(("#", ";")):
            yield line


def _find_mistake(name: str, target: str) -> str | None:
    if not target:
        return "its entry-point line is not NAME = package.module:Class"
    if not _NAME.fullmatch(name):
        return "a task's name has 1 to 100 letters, digits, _, - and ."
    if not _TARGET.fullmatch(target):
        return f"its target {short_repr(target)!r} is not package.module:Class"
    return None


def _find_problem(entry: TaskEntry, owner: TaskEntry) -> str | None:
    if entry is not owner:
        return f"name taken by {owner.distribution}; use {entry.target}"
    if entry.module_file is None:
        return f"module {entry.target.partition(':')[0]!r} is missing"
    return None


def check_import(entry: TaskEntry, timeout_s: float = 60.0) -> str | None:
    """Import a task in a child process; return its exception as one line, or None."""
    import subprocess

    code = (
        "from rlctl.environments import registry; from rlctl.errors import RlctlError\n"
        f"try: registry.load({entry.target!r})\n"
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


def explain_hidden_package(module: str) -> str:
    """Say which installed package hides the current folder's package of a module; empty if none does."""
    head = module.partition(".")[0]
    own = PathFinder.find_spec(head, [os.getcwd()])
    file, other = Path(*module.split(".")), find_module_file(head)
    if own is None or other is None or not (file.is_dir() or file.with_suffix(".py").is_file()):
        return ""
    return f": {other} hides {head}/ of this folder\nput this folder first: PYTHONPATH=. rlctl ..."
