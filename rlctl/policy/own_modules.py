"""Networks that a user writes: `policy_kwargs` of a recipe name them as `FILE.py:CLASS` or `MODULE:CLASS`.

A policy file names the classes of its training. They are imported only if the user names them too: in a recipe, in the
recipe of a run, or in `$RLCTL_NETWORKS`, a list of files. A policy file alone never causes an import.
"""

import inspect
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.environments import registry
from rlctl.environments.registry import import_file
from rlctl.errors import ArtifactError, RecipeError, RlctlError
from rlctl.recipe.recipe import Recipe
from rlctl.storage import files

KEYS = ("policy_class", "features_extractor_class", "activation_fn")  # the `policy_kwargs` that may name a class
VARIABLE = "RLCTL_NETWORKS"


def import_named(policy_kwargs: Mapping[str, Any]) -> dict[str, type]:
    """Import the classes that a recipe's `policy_kwargs` name, and return them by key.

    Raises `RecipeError` for a name without a class, and for any exception of the import.
    """
    names = {key: policy_kwargs.get(key) for key in KEYS}
    return {key: _import(key, name) for key, name in names.items() if isinstance(name, str) and ":" in name}


def list_names(recipe: Recipe) -> list[str]:
    """Return the names of a user's classes in a recipe, callbacks included."""
    networks = [recipe.policy_kwargs.get(key) for key in KEYS]
    return [*recipe.callbacks, *(name for name in networks if isinstance(name, str) and ":" in name)]


def locate(recipe: Recipe) -> Recipe:
    """Return a recipe with absolute paths of a user's files, so that a run can be resumed from any folder."""
    networks = {key: _locate(value) if key in KEYS else value for key, value in recipe.policy_kwargs.items()}
    callbacks = {_locate(name): arguments for name, arguments in recipe.callbacks.items()}
    return recipe.model_copy(update={"policy_kwargs": networks, "callbacks": callbacks})


def _locate(value: Any) -> Any:
    place, _, name = str(value).rpartition(":")
    file = Path(place).expanduser()
    if not file.is_file() and Path(file.name).is_file():
        file = Path(file.name)  # the recipe of a run on another machine; its files are in the current folder
    return f"{file.resolve()}:{name}" if place.endswith(".py") else value


def _import(key: str, name: str) -> type:
    try:
        cls = registry.load(name)
    except RlctlError as error:
        problem = str(error).removeprefix(f"task {name!r}: ")
        raise RecipeError(f"policy_kwargs.{key}: {name}: {problem}", details=error.details) from None
    if not (inspect.isclass(cls) and any(base.__module__.startswith("torch.nn.") for base in cls.__mro__)):
        raise RecipeError(f"policy_kwargs.{key}: {name}: not a class of torch.nn.Module")
    return cls


def describe_class(cls: type) -> dict[str, str]:
    """Return the name of a class, its file and the file's sha256, as plain data for a policy file."""
    module = sys.modules[cls.__module__]
    if cls.__module__.startswith("torch.nn."):
        return {"class": cls.__qualname__, "module": "torch.nn"}
    file = Path(str(module.__file__)).resolve()
    return {"class": cls.__qualname__, "file": str(file), "sha256": files.digest(file.read_bytes())}


def find_class(description: Mapping[str, str]) -> type:
    """Return the class that a policy file describes, if the user has named its module.

    Raises `ArtifactError` for a module that the user has not named, or that is missing or has changed.
    """
    name = str(description["class"])
    known = getattr(sys.modules["torch.nn"], name, None) if description.get("module") == "torch.nn" else None
    if inspect.isclass(known):
        return known
    file = Path(str(description["file"]))
    shown = f"{file}:{name}"
    if not file.is_file():
        raise ArtifactError(f"it was trained with {shown}; that file is missing: restore it")
    if (module := _find_module(file)) is None:
        advice = f"give the run, or set {VARIABLE}={file}"
        raise ArtifactError(f"it was trained with {shown}; a policy file alone never imports it: {advice}")
    cls = getattr(module, name, None)
    if files.digest(file.read_bytes()) != description["sha256"] or not inspect.isclass(cls):
        raise ArtifactError(f"it was trained with {shown}, which has changed; restore the version of the training")
    return cls


def _find_module(file: Path) -> Any:
    """Return the imported module of a file; imports a file that the environment variable names."""
    named = [Path(entry).expanduser().resolve() for entry in os.environ.get(VARIABLE, "").split(os.pathsep) if entry]
    if file in named:
        return import_file(str(file), file)
    loaded = (module for module in list(sys.modules.values()) if getattr(module, "__file__", None))
    return next((module for module in loaded if Path(str(module.__file__)).resolve() == file), None)


def describe_change(described: Mapping[str, Any], present: Mapping[str, Any]) -> str | None:
    """Return which own class differs between the `policy_kwargs` of two policies; None if all are the same."""
    for key in KEYS:
        before, now = described.get(key), present.get(key)
        if before != now and isinstance(before, dict) and isinstance(now, dict):
            return f"{now.get('file')}, with {now['class']}, is not the file that it was trained with"
    return None
