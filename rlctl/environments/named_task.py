"""Tasks that a file names. A file may name environments, and nothing else: no function, no script, no class of others.

A policy, a recorded episode or a run says which task it is for, with parameters; what they name is code on this
machine, and files are sent by others. A person who names a task on the command line may name anything.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlctl.environments import installed, registry
from rlctl.errors import ArtifactError
from rlctl.version import PACKAGE_FOLDER

POLICY = "a policy file"
EPISODE = "a recorded episode"
RUN = "run.json"

_MODULE_ID = re.compile(r"^([\w.]+):(?:[\w.-]+/)?[\w.-]+-v\d+$")
_LARGEST = 10 * 2**20  # [bytes] of a source file that is looked into


def load(task: str, named_by: str) -> Callable[..., Any]:
    """Import a task that `named_by` names, as `registry.load` does; raises `ArtifactError` unless it is one."""
    if not task.isprintable():
        raise _make_error(task, named_by, "that is not a name")
    if installed.find(task) is None and ":" in task:
        _look_before_import(task, named_by)
    constructor = registry.load(task)
    if not _may_be_called(task, constructor):
        raise _make_error(task, named_by, "that is not an environment class")
    return constructor


def _make_error(task: str, named_by: str, why: str) -> ArtifactError:
    shown = task if len(task) <= 80 else f"{task[:80]}..."
    hint = "; if you know what it is, name it yourself with --task" if named_by == POLICY else ""
    return ArtifactError(
        f"{named_by} names {shown!r} as its task, and {why}: not run, because a file may name environments only{hint}"
    )


def _look_before_import(task: str, named_by: str) -> None:
    """Raise `ArtifactError` for what cannot be an environment, judged by its source: importing it would run it."""
    by_id = _MODULE_ID.match(task)
    place, _, name = task.rpartition(":")
    file = registry.find_source_file(f"{place}:_")  # of a Gymnasium id, the module that registers it
    if file is None or not file.is_file():
        if place.partition(".")[0] in sys.stdlib_module_names:
            raise _make_error(task, named_by, "that is a part of Python")
        return  # nothing to import: the registry says so
    if file.suffix != ".py" or _is_of_python(file):
        raise _make_error(task, named_by, "that is a part of Python or of rlctl")
    source = _read_source(file)
    if by_id is not None:
        if "gymnasium" not in source:
            raise _make_error(task, named_by, "its module does not mention Gymnasium")
    elif not _defines(source, name.partition(".")[0]):
        raise _make_error(task, named_by, f"{file.name} does not define it")


def _is_of_python(file: Path) -> bool:
    """Say whether a file is of the standard library, under which packages are installed as well, or of rlctl."""
    library, file = Path(sysconfig.get_paths()["stdlib"]).resolve(), file.resolve()
    if file.is_relative_to(PACKAGE_FOLDER.resolve()):
        return True
    return file.is_relative_to(library) and not _is_installed(file)


def _is_installed(file: Path) -> bool:
    return bool({"site-packages", "dist-packages"} & set(file.resolve().parts))


def _read_source(file: Path) -> str:
    with file.open("rb") as opened:
        return opened.read(_LARGEST).decode(errors="replace")


def _defines(source: str, name: str) -> bool:
    """Say whether a module binds a name: by a class, a function, an assignment, or an import."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return True
        if isinstance(node, ast.ImportFrom) and {name, "*"} & {alias.asname or alias.name for alias in node.names}:
            return True
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == name:
            return True
    return False


def _may_be_called(task: str, constructor: Any) -> bool:
    """Say whether calling it makes an environment: a class of one, or what a user's own module says makes one."""
    import gymnasium

    if installed.find(task) is not None or hasattr(constructor, "gymnasium_id") or registry.is_task(constructor):
        return True
    if inspect.isclass(constructor) and issubclass(constructor, gymnasium.Env):
        return True
    # A function, or a class that only looks like an environment: of the user's own code, and about environments.
    try:
        file = Path(inspect.getfile(constructor))
    except (TypeError, OSError):
        return False
    source = registry.find_source_file(task)
    own = source is not None and source.expanduser().resolve() == file.resolve() and not _is_installed(file)
    return own and not _is_of_python(file) and bool(re.search("gymnasium|rlctl", _read_source(file)))
