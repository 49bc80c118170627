"""Gymnasium ids under which a class is registered too: with a time limit or arguments that the class alone lacks."""

import dataclasses
import inspect
import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlctl.environments.registry import load
from rlctl.errors import short_repr

_MOST_NAMED = 3


@dataclasses.dataclass(frozen=True)
class Registration:
    """An id of the environment that a class makes."""

    task: str  # the id, or `package:id`; empty where the module that registers it cannot be named
    folder: str  # the folder in which `task` is found; empty for the current one
    id: str
    max_episode_steps: int | None
    arguments: dict[str, Any]

    def __str__(self) -> str:
        limit = {} if self.max_episode_steps is None else {"max_episode_steps": self.max_episode_steps}
        added = ", ".join(f"{key}={short_repr(value, 40)}" for key, value in (limit | self.arguments).items())
        return f"{self.id} with {added}"

    def command(self, verb: str) -> str:
        """Return the command of rlctl for it; empty if there is none."""
        where = f"cd {shlex.quote(self.folder)} && " if self.folder else ""
        return f"{where}rlctl {verb} {shlex.quote(self.task)}" if self.task else ""


def find_registrations(task: str) -> list[Registration]:
    """Return the ids of a task's class; none for a task that is an id itself.

    Ids without a time limit and arguments are left out: they make what the class makes.
    """
    constructor, gymnasium = load(task), sys.modules.get("gymnasium")
    if gymnasium is None or not inspect.isclass(constructor):
        return []
    found = []
    for spec in sorted(gymnasium.registry.values(), key=lambda spec: -(spec.version or 0)):  # the newest first
        if (spec.max_episode_steps or spec.kwargs) and _find_imported(spec.entry_point) is constructor:
            name, folder = _name(task, constructor, spec.id)
            found.append(Registration(name, folder, spec.id, spec.max_episode_steps, dict(spec.kwargs)))
    return found


def describe_registrations(task: str, verb: str) -> str:
    """Return `also registered as Foo-v0 with max_episode_steps=200: rlctl VERB pkg:Foo-v0`; empty for none."""
    if not (registrations := find_registrations(task)):
        return ""
    named = "; ".join(map(str, registrations[:_MOST_NAMED]))
    more = f"; and {count} more ids" if (count := len(registrations) - _MOST_NAMED) > 0 else ""
    command = registrations[0].command(verb)
    return f"also registered as {named}{more}{command and f': {command}'}"


def _find_imported(entry_point: Any) -> Any:
    """Return what an entry point names, without importing its module."""
    if not isinstance(entry_point, str):
        return entry_point
    module, _, name = entry_point.partition(":")
    return getattr(sys.modules.get(module), name, None)


def _name(task: str, cls: type, identifier: str) -> tuple[str, str]:
    """Return how to name an id, with the outermost package that mentions it, and the folder in which that works."""
    modules = list(_list_modules(cls))
    if not modules or modules[0][0] == "gymnasium":
        return (identifier, "") if modules else ("", "")
    name = identifier.rpartition("/")[2].rpartition("-v")[0] or identifier
    mentions = (module for module, file in modules if name in file.read_text(encoding="utf-8", errors="replace"))
    package = next(mentions, modules[-1][0])
    root = modules[0][1].parent
    root = root.parent if modules[0][1].name == "__init__.py" else root
    is_here = not task.rpartition(":")[0].endswith(".py") or root == Path.cwd()
    return f"{package}:{identifier}", "" if is_here else os.path.relpath(root)


def _list_modules(cls: type) -> Iterator[tuple[str, Path]]:
    """Yield a class's module and its packages with their files, the outermost first; none if they cannot be named."""
    parts = cls.__module__.split(".")
    names = [".".join(parts[:depth]) for depth in range(1, len(parts) + 1)]
    files = [Path(getattr(sys.modules.get(name), "__file__", None) or "") for name in names]
    if files[-1].stem in (parts[-1], "__init__"):  # else its file's name was taken by another module
        yield from ((name, file) for name, file in zip(names, files, strict=True) if file.suffix == ".py")
