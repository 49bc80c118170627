"""From what the user typed to an environment: names are listed without importing a plugin, one is loaded.

A task is written as an installed name (`reach`), `package.module:Class`, `path/to/file.py:Class`, or a Gymnasium id
(`Pendulum-v1`, `package:Env-v0`).
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib.metadata
import inspect
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlctl.environments.plugin_code import find_module_file, import_file, import_module
from rlctl.errors import NoSuchClassError, OldGymError, TaskError, UsageError, did_you_mean

GROUP = "rlctl.tasks"
OURS = "rlctl"

_GYMNASIUM_ID = re.compile(r"^(?:[\w.]+:)?(?:[\w.-]+/)?[\w.-]+-v\d+$")


@dataclasses.dataclass(frozen=True)
class TaskEntry:
    """An installed task, as its distribution declares it; nothing of it is imported."""

    name: str
    target: str
    """`package.module:Class`."""
    distribution: str
    version: str
    problem: str | None = None
    """Why it cannot be used under its name, if so."""

    @property
    def module_file(self) -> Path | None:
        """The module's file, found without importing it or its packages."""
        return find_module_file(self.target.partition(":")[0])

    @property
    def recipe_file(self) -> Path | None:
        """The packaged recipe: `<name>.yaml` beside the module, or the module's own, `<module>.yaml`."""
        file = self.module_file
        if file is None:
            return None
        return _keep_existing(file.with_name(f"{self.name}.yaml")) or _keep_existing(file.with_suffix(".yaml"))

    @property
    def policy_file(self) -> Path | None:
        """The shipped policy: `policies/<name>.safetensors` beside the module."""
        file = self.module_file
        return _keep_existing(file.parent / "policies" / f"{self.name}.safetensors") if file else None


def list_installed() -> list[TaskEntry]:
    """Return every installed task, by name; of two with one name the bundled one, or the first, can be used.

    They are looked for anew where `sys.path`, or a folder on it, has changed.
    """
    return list(_list_installed(tuple((folder, _find_state(folder or os.curdir)) for folder in sys.path)))


def _find_state(folder: str) -> tuple[int, ...]:
    """Return which folder it is, and when something was added or removed; empty if it is none."""
    try:
        state = os.stat(folder)
    except OSError:
        return ()
    return state.st_dev, state.st_ino, state.st_mtime_ns


@functools.lru_cache(maxsize=4)
def _list_installed(path: tuple[tuple[str, tuple[int, ...]], ...]) -> list[TaskEntry]:
    found: list[TaskEntry] = []
    seen: set[tuple[str, str]] = set()
    named: dict[Any, tuple[str, str]] = {}  # each look at a distribution's name or version reads its metadata anew
    for point in importlib.metadata.entry_points(group=GROUP):
        if (point.name, point.value) in seen:  # a checkout on sys.path beside its own installation
            continue
        seen.add((point.name, point.value))
        if point.dist not in named:
            metadata: Any = point.dist.metadata if point.dist else {}
            named[point.dist] = (metadata.get("Name") or "?", metadata.get("Version") or "?")
        found.append(TaskEntry(point.name, point.value, *named[point.dist]))
    found.sort(key=lambda entry: (entry.name, entry.distribution != OURS, entry.distribution))
    entries: list[TaskEntry] = []
    for entry in found:
        problem = None
        if entries and entries[-1].name == entry.name:
            first = next(e for e in entries if e.name == entry.name)
            problem = f"name taken by {first.distribution}; use {entry.target}"
        elif entry.module_file is None:
            problem = f"module {entry.target.partition(':')[0]!r} is missing"
        entries.append(dataclasses.replace(entry, problem=problem))
    return entries


def find(name: str) -> TaskEntry | None:
    """Return the installed task that a name stands for."""
    if ":" in name:  # names a module, a file or a package
        return None
    return next((entry for entry in list_installed() if entry.name == name), None)


def check_import(entry: TaskEntry, timeout_s: float = 60.0) -> str | None:
    """Import a task in a child process; return what it raised, in a line, or None."""
    import subprocess

    code = (
        "import sys; sys.path.insert(0, '')\n"
        "from rlctl.environments import registry; from rlctl.errors import RlctlError\n"
        f"try: registry.load({entry.target!r})\n"
        "except RlctlError as error: print('\\n@' + str(error).splitlines()[0]); sys.exit(3)\n"
        "print('\\n@')"
    )
    try:
        child = subprocess.run(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"import did not end within {timeout_s:.0f} s"
    lines = [line[1:] for line in child.stdout.splitlines() if line.startswith("@")]
    if not lines:
        return f"import ended the process with exit code {child.returncode}"
    return lines[-1] or None


def load(task: str) -> Callable[..., Any]:
    """Import what `task` names: a `Task` class, or anything that returns a Gymnasium environment when called."""
    _put_current_folder_on_path()
    if entry := find(task):
        if entry.problem:
            raise TaskError(f"task {task!r} of {entry.distribution} {entry.version}: {entry.problem}")
        return _load_target(task, entry.target)
    if _GYMNASIUM_ID.match(task):
        package = task.rpartition(":")[0]
        if package and find_module_file(package) is not None:
            import_module(task, package)  # here, so that what it raises is known as an import's
        return _load_gymnasium(task)
    if ":" in task:
        return _load_target(task, task)
    if task.endswith(".py") and (file := Path(task).expanduser()).is_file():
        classes = _list_classes(file)
        forms = " or ".join(f"{task}:{name}" for name in classes) or f"{task}:CLASS; it defines no class"
        raise UsageError(f"{task}: name the class in it: {forms}")
    if task and Path(task).is_dir():
        raise UsageError(
            f"{task} is a folder, not a task: pip install -e {task} installs a plugin; or name a class: "
            f"{task}/FILE.py:CLASS"
        )
    names = [entry.name for entry in list_installed()]
    raise UsageError(
        f"no task {task!r}.{did_you_mean(task, names)} Installed: {', '.join(dict.fromkeys(names)) or 'none'}. "
        "Other forms: package.module:Class, path/to/file.py:Class, Pendulum-v1."
    )


def _list_classes(file: Path) -> list[str]:
    """Return the public classes that a file defines, without importing it: those that look like tasks, or all."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError):
        return []
    found = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    bases = {node.name: " ".join(map(ast.unparse, node.bases)) for node in found}
    return [name for name, base in bases.items() if "Task" in base or "Env" in base] or list(bases)


def is_task(constructor: Any) -> bool:
    """Say whether what was loaded is a `rlctl.task.Task` class."""
    task_module = sys.modules.get("rlctl.task.task")
    return task_module is not None and inspect.isclass(constructor) and issubclass(constructor, task_module.Task)


def find_recipe_file(task: str) -> Path | None:
    """Return the recipe that comes with a task: `<name>.yaml` beside its module, or `<file>.yaml` beside its file."""
    if entry := find(task):
        return entry.recipe_file
    file = find_source_file(task)
    return _keep_existing(file.with_suffix(".yaml")) if file else None


def find_source_file(task: str) -> Path | None:
    """Return the file that a task is written in, found without importing it; None for a Gymnasium id."""
    _put_current_folder_on_path()
    if entry := find(task):
        return entry.module_file
    if _GYMNASIUM_ID.match(task) or ":" not in task:
        return None
    place = task.rpartition(":")[0]
    return Path(place) if place.endswith(".py") else find_module_file(place)


def _keep_existing(file: Path) -> Path | None:
    return file if file.is_file() else None


def find_origin(task: str) -> dict[str, str]:
    """Return what to write down about where a task comes from: `distribution` and `version`, where known."""
    if entry := find(task):
        return {"distribution": entry.distribution, "version": entry.version}
    return {}


def make_slug(task: str) -> str:
    """Return a folder name for a task: `reach`, `MyEnv`, `Pendulum-v1`."""
    return re.sub(r"[^\w.-]+", "-", task.rpartition(":")[2]).strip("-.") or "task"


def _put_current_folder_on_path() -> None:
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


def _load_target(task: str, target: str) -> Callable[..., Any]:
    place, _, attribute = target.rpartition(":")
    module = import_file(task, Path(place)) if place.endswith(".py") else import_module(task, place)
    constructor = module
    for part in attribute.split("."):
        if not hasattr(constructor, part):
            if attribute in getattr(sys.modules.get("gymnasium"), "registry", ()):
                return _load_gymnasium(attribute)  # an id without a version, which the module has registered
            classes = [name for name, value in vars(module).items() if inspect.isclass(value)]
            own = [name for name in classes if getattr(module, name).__module__ == module.__name__]
            raise NoSuchClassError(
                f"{place} has no {attribute!r}.{did_you_mean(attribute, classes)} "
                f"It defines: {', '.join(own) or 'no class'}."
            )
        constructor = getattr(constructor, part)
    if not callable(constructor):
        raise NoSuchClassError(f"{target}: {attribute} is a {type(constructor).__name__}, not a class or a function")
    return constructor  # type: ignore[no-any-return]


def _load_gymnasium(task: str) -> Callable[..., Any]:
    import gymnasium

    spec = gymnasium.registry.get(task.rpartition(":")[2])
    if spec is not None and isinstance(spec.entry_point, str):
        module = spec.entry_point.partition(":")[0]
        if find_module_file(module) is not None:
            import_module(task, module)  # as in `load`: an import that fails is no constructor that fails

    def constructor(**parameters: Any) -> Any:
        try:
            return gymnasium.make(task, disable_env_checker=True, **parameters)
        except gymnasium.error.UnregisteredEnv:
            name = task.rpartition(":")[2]
            if _is_in_old_gym(name):
                raise OldGymError(f"{name} is registered with the old gym, where Gymnasium does not find it") from None
            close = did_you_mean(name, gymnasium.registry)
            raise UsageError(f"Gymnasium has no environment {task!r}.{close}") from None
        except gymnasium.error.DeprecatedEnv as error:
            raise UsageError(f"Gymnasium: {task}: {error}") from None
        except ModuleNotFoundError as error:
            missing = getattr(error.__cause__, "name", None) or error.name
            if missing and missing != task.partition(":")[0]:
                raise  # the module is there, and something that it imports is not
            raise UsageError(f"Gymnasium: {task}: {error}") from None

    constructor.gymnasium_id = task  # type: ignore[attr-defined]
    return constructor


def _is_in_old_gym(name: str) -> bool:
    """Say whether the old gym, if something has imported it, knows an id."""
    old = getattr(sys.modules.get("gym"), "envs", None)
    known = getattr(old, "registry", {})
    return name in getattr(known, "env_specs", known)
