"""Imports and calls the code of plugins. Any exception from it becomes an error of one line."""

import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from rlctl import errors
from rlctl.errors import TaskError, UsageError


def call_plugin(task: str, call: Callable[[], Any], doing: str = "") -> Any:
    """Call a plugin's code; any exception from it, `SystemExit` included, becomes a `TaskError`."""
    try:
        return call()
    except (errors.RlctlError, KeyboardInterrupt):
        raise
    except BaseException as error:
        where = ""
        frames = traceback.extract_tb(error.__traceback__)
        own = frames and Path(frames[-1].filename).parent == Path(__file__).parent
        if frames and not own and not frames[-1].filename.startswith("<frozen"):  # a syntax error names its place
            where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})"
        raise TaskError(
            f"task {task!r}: {doing}{errors.describe_exception(error)}{where}",
            details=errors.format_plugin_traceback(error) or None,
        ) from error


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
            path = spec.submodule_search_locations
            specs = (finder.find_spec(name, path) for finder in sys.meta_path if hasattr(finder, "find_spec"))
            spec = next((candidate for candidate in specs if candidate is not None), None)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin and spec.has_location else None


def import_module(task: str, name: str) -> Any:
    """Import a module that is installed or in the current folder; raises `TaskError` for any exception in it."""
    is_installed = name in sys.modules or find_module_file(name) is not None
    if not is_installed and find_module_file(name, in_current_folder=True) is None:
        raise UsageError(f"task {task!r}: no module {name!r} is installed or under {os.getcwd()}")
    return call_plugin(task, lambda: importlib.import_module(name), doing="import failed: ")


def import_file(task: str, file: Path) -> Any:
    """Import a file as a module, once. Its folder becomes the last entry of `sys.path`."""
    file = _find_loaded(file.expanduser())
    if not file.is_file():
        raise UsageError(f"task {task!r}: no file {file}")
    path = str(file)
    for loaded, known in list(sys.modules.items()):
        if getattr(known, "__file__", None) == path and loaded != "__main__":
            return known
    append_to_path(str(file.parent))
    name = file.stem
    while name in sys.modules or name in sys.stdlib_module_names:
        name = f"rlctl_task_{name}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise UsageError(f"task {task!r}: {file} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    loader = spec.loader
    try:
        call_plugin(task, lambda: loader.exec_module(module), doing="import failed: ")
    except BaseException:
        sys.modules.pop(name, None)
        raise
    return module


def append_to_path(folder: str) -> None:
    """Append a folder to `sys.path`; it comes last so that a `torch.py` in it does not hide torch."""
    if folder not in sys.path:
        sys.path.append(folder)


def _find_loaded(file: Path) -> Path:
    """Return a file's absolute path, also if the working directory has changed since the file was loaded."""
    loaded = (getattr(module, "__file__", None) or "" for module in list(sys.modules.values()))
    before = None if file.exists() else next((path for path in loaded if Path(path).match(str(file))), None)
    return Path(before or file).resolve()
