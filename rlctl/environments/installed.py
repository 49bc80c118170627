"""Installed tasks: the entry points of the group `rlctl.tasks` in all distributions. Imports no plugin."""

import dataclasses
import os
from importlib.machinery import PathFinder
from pathlib import Path

from rlctl.entry_points import EntryPoint, call_in_child, find_module_file, list_entry_points

GROUP = "rlctl.tasks"


@dataclasses.dataclass(frozen=True)
class TaskEntry(EntryPoint):
    """An installed task, as its distribution declares it; its code is not imported."""

    what = "task"
    form = "package.module:Class"

    def describe_taken(self, owner: str) -> str:
        """Return the problem of a name that `owner` has: the task can be used by its class."""
        return f"name taken by {owner}; use {self.target}"

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
    """Return every installed task, sorted by name. Of two with the same name, rlctl's own or the first can be used."""
    return list_entry_points(GROUP, TaskEntry)


def find(name: str) -> TaskEntry | None:
    """Return the installed task with this name, or None."""
    if ":" in name:  # names a module, a file or a package
        return None
    return next((entry for entry in list_installed() if entry.name == name), None)


def check_import(entry: TaskEntry) -> str | None:
    """Import a task in a child process; return its exception as one line, or None."""
    return call_in_child("rlctl.environments.registry", "load", entry.target)


def explain_hidden_package(module: str) -> str:
    """Say which installed package hides the current folder's package of a module; empty if none does."""
    head = module.partition(".")[0]
    own = PathFinder.find_spec(head, [os.getcwd()])
    file, other = Path(*module.split(".")), find_module_file(head)
    if own is None or other is None or not (file.is_dir() or file.with_suffix(".py").is_file()):
        return ""
    return f": {other} hides {head}/ of this folder\nput this folder first: PYTHONPATH=. rlctl ..."
