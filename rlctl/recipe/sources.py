"""Where a recipe comes from: a task's packaged YAML, then `--config`, then `--set` and the other flags."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlctl.environments import registry
from rlctl.environments.spec import EnvChanges, merge
from rlctl.errors import ArtifactError, RecipeError, did_you_mean, short_repr
from rlctl.recipe.hyperparameters import ON_POLICY
from rlctl.recipe.recipe import NormalizeSettings, Recipe, Source, validate
from rlctl.storage import yaml_text

_PRESETS = Path(__file__).with_name("presets")
"""Recipes that `--config` finds by name."""
_DEEPEST_KEY = 20
_DEFAULT_ROLLOUT = 4096  # [steps], all environments together
_OF_THE_ENVIRONMENT = ("task", "reward_weights", "randomize", "events")
_OF_THE_ALGORITHM = ("algo", "algo_kwargs", "policy_kwargs", "her", "normalize", "n_envs", "total_timesteps")


def resolve(
    task: str, config: Path | None, settings: Mapping[str, Any], stages: Sequence[Mapping[str, Any]] = ()
) -> Recipe:
    """Merge the packaged recipe, `--config` and the command line's settings, and check every key.

    `stages` are those that the task's class declares; a recipe that has the key replaces them.
    """
    packaged_file = registry.find_recipe_file(task)
    packaged = read(packaged_file) if packaged_file else {}
    config = find_config(config) if config else None
    from_config = read(config) if config else {}
    given = merge(from_config, settings)
    sources = [
        Source("", settings),
        Source(str(config), from_config, config),
        Source(str(packaged_file), packaged, packaged_file),
    ]
    algo = given.get("algo", packaged.get("algo", "ppo"))
    if packaged.get("algo", "ppo") != algo:
        # Hyperparameters of another algorithm would be wrong here, and so would its number of environments.
        packaged = {k: v for k, v in packaged.items() if k not in _OF_THE_ALGORITHM}
    merged = merge(packaged, given)
    if stages and "stages" not in merged:
        merged["stages"] = validate({"stages": list(stages)}, f"class of {task}").model_dump(by_alias=True)["stages"]
    return fill_defaults(validate(merged, *sources))


def resolve_with_stages(task: str, config: Path | None, settings: Mapping[str, Any]) -> Recipe:
    """Return what `resolve` does, with the stages that the task's class declares; the task is imported."""
    constructor: Any = registry.load(task)
    return resolve(task, config, settings, constructor.stages if registry.is_task(constructor) else ())


def resolve_packaged(task: str, settings: Mapping[str, Any] | None = None) -> Recipe:
    """Return the recipe that a task comes with, with the stages that its class declares; the task is imported."""
    return resolve_with_stages(task, None, settings or {})


def fill_defaults(recipe: Recipe) -> Recipe:
    """Fill in what the algorithm decides: rollout length, normalisation, how often to evaluate."""
    changes: dict[str, Any] = {}
    kwargs = dict(recipe.algo_kwargs)
    on_policy = recipe.algo in ON_POLICY
    if recipe.algo in ("ppo", "recurrent_ppo"):
        n_steps = min(max(_DEFAULT_ROLLOUT // recipe.n_envs, 16), 2048)
        kwargs.setdefault("n_steps", n_steps)
        kwargs.setdefault("batch_size", min(128, int(kwargs["n_steps"]) * recipe.n_envs))
    if not on_policy:
        # One gradient step per environment step, however many environments there are.
        kwargs.setdefault("gradient_steps", -1)
        kwargs.setdefault("train_freq", 1)
        kwargs.setdefault("buffer_size", min(1_000_000, max(recipe.total_timesteps, 1_000)))
    changes["algo_kwargs"] = kwargs
    if recipe.normalize is None:
        changes["normalize"] = NormalizeSettings(observation=on_policy, reward=on_policy)
    if recipe.eval.every_steps is None:
        changes["eval"] = recipe.eval.model_copy(update={"every_steps": max(1, recipe.total_timesteps // 10)})
    return recipe.model_copy(update=changes)


def describe_rounding(recipe: Recipe) -> str | None:
    """Describe how many steps are trained where whole rollouts make clearly more of them than `total_timesteps`."""
    if recipe.algo not in ON_POLICY:
        return None
    rollout = int(recipe.algo_kwargs.get("n_steps", 5)) * recipe.n_envs
    steps = math.ceil(recipe.total_timesteps / rollout) * rollout
    if steps <= 1.1 * recipe.total_timesteps:
        return None
    return (
        f"{steps:,} steps will be trained, not {recipe.total_timesteps:,}: {recipe.algo} trains whole rollouts, of "
        f"{rollout:,} steps here (n_steps x n_envs)"
    )


def read(path: Path) -> dict[str, Any]:
    """Read a recipe file as plain data, unchecked."""
    if not path.exists():
        raise ArtifactError(f"no recipe file {path}; presets: {', '.join(list_presets())}")
    content = yaml_text.load(yaml_text.read_text(path), str(path))
    if content is not None and not isinstance(content, dict):
        raise RecipeError(f"{path}: a recipe is a mapping of keys to values, this is a {type(content).__name__}")
    return content or {}


def list_presets() -> dict[str, Path]:
    """Return the names that `--config` knows, `presets/ppo` and so on, and their files."""
    return {f"{_PRESETS.name}/{file.stem}": file for file in sorted(_PRESETS.glob("*.yaml"))}


def find_config(config: Path) -> Path:
    """Return the file of a `--config`: a preset's where no file has that name, else the path itself.

    Raises `ArtifactError` for a preset that does not exist.
    """
    if config.exists() or len(config.parts) != 2 or config.parts[0] != _PRESETS.name or config.suffix:
        return config
    file = _PRESETS / f"{config.name}.yaml"
    if not file.exists():
        presets = list_presets()
        raise ArtifactError(
            f"no preset {str(config)!r}.{did_you_mean(str(config), presets)} There are: {', '.join(presets)}."
        )
    return file


def parse_settings(settings: list[str]) -> dict[str, Any]:
    """Turn `--set` texts such as `algo_kwargs.gamma=0.97` into a nested mapping."""
    result: dict[str, Any] = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise RecipeError(f"--set {short_repr(text)!r}: write key=value, for example --set task.tolerance=0.02")
        *path, last = key.strip().split(".")
        if len(path) >= _DEEPEST_KEY or not all((*path, last)):
            raise RecipeError(f"--set {short_repr(text)!r}: a key is names joined by dots, such as task.tolerance")
        place = result
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise RecipeError(f"--set {short_repr(text)!r}: {part!r} has been given a value already")
        place[last] = yaml_text.load(value, f"--set {key}")
    return result


def parse_changes(settings: list[str]) -> EnvChanges:
    """Return what `--set` changes in an environment; raises `RecipeError` for a key that is not of one."""
    return check_changes(parse_settings(settings), "--set")


def check_changes(values: Mapping[str, Any], source: str) -> EnvChanges:
    """Check the keys of a recipe that are about the environment; raises `RecipeError` for another key."""
    for key in values:
        if key not in _OF_THE_ENVIRONMENT:
            can = "task.NAME, reward_weights.NAME, randomize and events.NAME can be set here"
            raise RecipeError(f"{source} {key}: only {can}.{did_you_mean(key, _OF_THE_ENVIRONMENT)}")
    recipe = validate(values, source)
    randomize = recipe.randomize if "randomize" in values else None
    return EnvChanges(recipe.task, recipe.reward_weights, randomize, recipe.events)


def merge_flags(settings: list[str], **flags: Any) -> dict[str, Any]:
    """Return the settings of `--set` with those of the flags that were given put over them."""
    values = parse_settings(settings)
    for name, value in flags.items():
        if value is not None:
            values[name] = yaml_text.load(value, name) if isinstance(value, str) else value
    return values
