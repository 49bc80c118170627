"""Recipe files as plain data, unchecked, and what is known from them without pydantic's models, which load slowly."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.engine import Engine
from rlctl.environments import registry
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError, check_name


def read(path: Path) -> dict[str, Any]:
    """Read a recipe file as plain data, unchecked."""
    presets = list_presets()
    if not path.exists():
        meant = [preset for preset in presets if preset.lower() == f"{registry.PRESETS.name}/{path.stem}".lower()]
        close = f" Did you mean {meant[0]!r}?" if meant else ""
        raise ArtifactError(f"no recipe file {path}.{close} Presets: {', '.join(presets)}")
    if path.is_dir():
        inside = sorted(path.glob("*.yaml"))  # `recipe.yaml` of a run
        hint = f"in it is {inside[0]}" if inside else "there is no .yaml file in it"
        raise ArtifactError(f"{path}: a folder, not a recipe; {hint}")
    from rlctl.storage import yaml_text  # most environments have no recipe

    content = yaml_text.load(yaml_text.read_text(path), str(path))
    if content is not None and not isinstance(content, dict):
        raise RecipeError(f"{path}: expected a mapping of keys to values, got a {type(content).__name__}")
    return content or {}


def list_presets() -> dict[str, Path]:
    """Return the presets of `--config`: name (`presets/ppo`) and file."""
    return {f"{registry.PRESETS.name}/{file.stem}": file for file in sorted(registry.PRESETS.glob("*.yaml"))}


def read_comment(file: Path) -> str:
    """Return the comment at the beginning of a recipe file as one text."""
    lines = itertools.takewhile(lambda line: line.startswith("# "), file.read_text(encoding="utf-8").splitlines())
    return " ".join(line[2:] for line in lines)


def describe_own_preset(task: str) -> str:
    """Return name and comment of the preset that a Gymnasium id has as its recipe; empty for any other task."""
    file = registry.find_recipe_file(task)
    if file is None or file.parent != registry.PRESETS:
        return ""
    return f"recipe {registry.PRESETS.name}/{file.stem}: {read_comment(file)}"


def find_config(config: Path) -> Path:
    """Return the file of a `--config`: the path itself, or a preset's file if no file has that name.

    Raises `ArtifactError` for a preset that does not exist.
    """
    if config.exists() or len(config.parts) != 2 or config.parts[0] != registry.PRESETS.name or config.suffix:
        return config
    file = registry.PRESETS / f"{config.name}.yaml"
    check_name(str(config), list_presets(), "no preset", ArtifactError, listed="Presets")
    return file


def make_spec(task: str, parameters: Mapping[str, Any] | None = None) -> EnvSpec:
    """Return the environment of a task that the user named: of its recipe only the engine counts.

    Raises `RecipeError` if the recipe names no engine that exists.
    """
    file = registry.find_recipe_file(task)
    packaged = read(file) if file else {}
    if "sim" not in packaged:
        return EnvSpec(task, parameters or {}, sim=Engine())
    from rlctl.recipe.recipe import Source, validate

    named = {"sim": packaged["sim"]}
    recipe = validate(named, Source(str(file), named, file))
    return EnvSpec(task, parameters or {}, sim=recipe.sim or Engine())
