"""Check tasks that a file names, before they are imported: a file may name environments and nothing else.

Policies, recorded episodes and runs contain the name of their task, and loading it runs code on this machine. The
file may come from somebody else, so other functions, scripts and classes are refused. A user on the command line may
name anything.
"""

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
RUN, GROUP, TUNING = "run.json", "group.json", "tune.json"


def load(task: str, named_by: str) -> Callable[..., Any]:
    """Import a task that a file of kind `named_by` names; raises `ArtifactError` if it is not an environment."""
    check_source(task, named_by)
    constructor = registry.load(task)
    if not _may_be_called(task, constructor):
        raise _make_error(task, named_by, "it is not an environment class")
    return constructor


def check_source(task: str, named_by: str) -> None:
    """Raise `ArtifactError` if the source of a task shows that it is not an environment; import nothing."""
    if not task.isprintable():
        raise _make_error(task, named_by, "it contains unprintable characters")
    if installed.find(task) is None and ":" in task:
        _look_before_import(task, named_by)


def _make_error(task: str, named_by: str, why: str) -> ArtifactError:
    shown = task if len(task) <= 80 else f"{task[:80]}..."
    hint = "; if you trust it, name it with --task" if named_by == POLICY else ""
    not_run = f"not run, because a file may name environments only{hint}"
    return ArtifactError(f"{named_by} names {shown!r} as its task, but {why}; {not_run}")


def _look_before_import(task: str, named_by: str) -> None:
    """Raise `ArtifactError` if the source shows that it cannot be an environment; an import would already run it."""
    place, _, name = task.rpartition(":")
    file = registry.find_source_file(f"{place}:_")  # of a Gymnasium id, the module that registers it
    if file is None or not file.is_file():
        if place.partition(".")[0] in sys.stdlib_module_names:
            raise _make_error(task, named_by, "it is part of Python")
        return  # nothing to import; `registry.load` raises the error
    if file.suffix != ".py" or _is_of_python(file):
        raise _make_error(task, named_by, "it is part of Python or rlctl")
    source = file.read_text(encoding="utf-8", errors="replace")
    if "gymnasium" not in source:
        if registry.is_gymnasium_id(task):
            raise _make_error(task, named_by, "its module does not mention Gymnasium")
        # With Gymnasium, a name that is not defined may be an id without a version: see `_may_be_called`.
        if not _defines(source, name.partition(".")[0]):
            raise _make_error(task, named_by, f"{file.name} does not define it")


def _is_of_python(file: Path) -> bool:
    """Return whether a file belongs to rlctl or the standard library; installed packages do not count."""
    library, file = Path(sysconfig.get_paths()["stdlib"]).resolve(), file.resolve()
    return file.is_relative_to(PACKAGE_FOLDER.resolve()) or (file.is_relative_to(library) and not _is_installed(file))


def is_own_file(file: Path) -> bool:
    """Return whether a file is the user's: not of rlctl, Python or an installed package."""
    return not _is_of_python(file) and not _is_installed(file)


def _is_installed(file: Path) -> bool:
    return bool({"site-packages", "dist-packages"} & set(file.resolve().parts))


def _defines(source: str, name: str) -> bool:
    """Return whether a module defines a name: as a class or function, by an assignment or an import."""
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
    """Return whether it may be called: an environment class, or anything that the user's own module defines."""
    import gymnasium

    if installed.find(task) is not None or hasattr(constructor, "gymnasium_id") or registry.is_task(constructor):
        return True
    if inspect.isclass(constructor) and issubclass(constructor, gymnasium.Env):
        return True
    # A function or another class: only from the user's own file, and only if that mentions Gymnasium or rlctl.
    try:
        file = Path(inspect.getfile(constructor))
    except (TypeError, OSError):
        return False
    source = registry.find_source_file(task)
    own = source is not None and source.expanduser().resolve() == file.resolve() and is_own_file(file)
    return own and bool(re.search(b"gymnasium|rlctl", file.read_bytes()))
