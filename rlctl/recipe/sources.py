"""Merges the sources of a recipe: a task's packaged YAML, then `--config`, then `--set` and the other flags."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlctl.engine import Engine
from rlctl.environments import registry
from rlctl.environments.parameters import check_given
from rlctl.environments.spec import EnvChanges, merge
from rlctl.errors import RecipeError, did_you_mean, short_repr
from rlctl.recipe.hyperparameters import ON_POLICY
from rlctl.recipe.recipe import WITH_PRIVILEGED, NormalizeSettings, Recipe, Source, validate
from rlctl.recipe.recipe_files import find_config, read
from rlctl.storage import yaml_text

_DEEPEST_KEY = 20
_FEWEST_EVALUATIONS = 5
_WITH_UNIT = re.compile(r"([\d.]+)([kKmM])")
_DEFAULT_ROLLOUT = 4096  # [steps], all environments together
OF_THE_ENVIRONMENT = ("task", "reward_weights", "randomize", "events", "sim")
_DEFAULT_ALGORITHM = "ppo"
_OF_THE_ALGORITHM = ("algo", "algo_kwargs", "policy_kwargs", "her", "normalize", "mirror", "mirror_loss")
_OF_ANY_ALGORITHM = ("n_envs", "total_timesteps")  # how much is trained: equal where algorithms are compared


def resolve(
    task: str, config: Path | None, settings: Mapping[str, Any], stages: Sequence[Mapping[str, Any]] = ()
) -> Recipe:
    """Merge the packaged recipe, `--config` and the command line's settings, and check every key.

    `stages` are those of the task's class; the key `stages` of a recipe replaces them.
    """
    sources = _list_sources(task, config, settings)
    _, from_config, packaged = (_select_values(source, sources) for source in sources)
    overrides = merge(from_config, settings)
    merged = merge(packaged, overrides)
    if stages and "stages" not in merged:
        merged["stages"] = validate({"stages": list(stages)}, f"class of {task}").model_dump(by_alias=True)["stages"]
    recipe = fill_defaults(validate(merged, *sources))
    is_other_length = "total_timesteps" in overrides and recipe.total_timesteps != packaged.get("total_timesteps")
    if is_other_length and "every_steps" not in (overrides.get("eval") or {}):
        # The packaged interval is for the packaged length.
        every = min(recipe.eval.every_steps or 1, max(1, recipe.total_timesteps // _FEWEST_EVALUATIONS))
        recipe = recipe.model_copy(update={"eval": recipe.eval.model_copy(update={"every_steps": every})})
    return recipe


def _list_sources(task: str, config: Path | None, settings: Mapping[str, Any]) -> tuple[Source, Source, Source]:
    """Return the command line's settings, `--config` and the packaged recipe, in order of precedence."""
    packaged_file = registry.find_recipe_file(task)
    packaged = read(packaged_file) if packaged_file else {}
    config = find_config(config) if config else None
    from_config = read(config) if config else {}
    return (
        Source("", settings),
        Source(str(config), from_config, config),
        Source(str(packaged_file), packaged, packaged_file),
    )


def _choose_algorithm(sources: Sequence[Source]) -> Any:
    named = (source.values["algo"] for source in sources if "algo" in source.values)
    return next(named, _DEFAULT_ALGORITHM)


def _is_for_another_algorithm(source: Source, sources: Sequence[Source]) -> bool:
    """Return whether a source of higher precedence names another algorithm than this one is for."""
    algo = _choose_algorithm(sources)
    if source is sources[-1]:
        return bool(source.values.get("algo", _DEFAULT_ALGORITHM) != algo)
    return bool(source.values.get("algo", algo) != algo)  # without `algo` it is for any, as the user says


def _select_values(source: Source, sources: Sequence[Source]) -> dict[str, Any]:
    """Return the values of a source that fit the chosen algorithm."""
    if not _is_for_another_algorithm(source, sources):
        return dict(source.values)
    lost = _list_keys_of_algorithm(_choose_algorithm(sources))
    return {key: value for key, value in source.values.items() if key not in lost}


def _list_keys_of_algorithm(chosen: Any) -> tuple[str, ...]:
    """Return the keys that a recipe for another algorithm than `chosen` loses."""
    if chosen in WITH_PRIVILEGED:
        return _OF_THE_ALGORITHM
    return (*_OF_THE_ALGORITHM, "privileged")


def find_given_parameters(task: str, config: Path | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the algorithm's parameters that `--config` and the command line give, not the packaged recipe."""
    sources = _list_sources(task, config, settings)
    from_line, from_config, _ = (_select_values(source, sources) for source in sources)
    return merge(from_config.get("algo_kwargs") or {}, from_line.get("algo_kwargs") or {})


def describe_other_algorithm(task: str, config: Path | None, settings: Mapping[str, Any]) -> list[str]:
    """Return a line for each recipe that is for another algorithm than the chosen one: what does not carry over."""
    sources = _list_sources(task, config, settings)
    algo = _choose_algorithm(sources)
    lines = []
    for number, source in enumerate(sources):
        lost = [key for key in _list_keys_of_algorithm(algo) if key in source.values and key != "algo"]
        if not lost or not _is_for_another_algorithm(source, sources):
            continue
        its_algorithm = source.values.get("algo", _DEFAULT_ALGORITHM)
        line = f"{source.name} is for {its_algorithm}; not used for {algo}: {', '.join(lost)}"
        above = [key for higher in sources[:number] for key in higher.values]
        used = [key for key in _OF_ANY_ALGORITHM if key in source.values and key not in above]
        if used:
            line += f"; used: {', '.join(f'{key} {source.values[key]}' for key in used)}"
        lines.append(line)
    return lines


def resolve_with_stages(task: str, config: Path | None = None, settings: Mapping[str, Any] | None = None) -> Recipe:
    """Resolve a recipe, including the stages that the task's class declares; the task is imported, and not built.

    Raises `UsageError` for an id that Gymnasium does not know, `RecipeError` for parameters that the task lacks.
    """
    constructor: Any = registry.load(task)
    registry.check_registered(constructor)
    recipe = resolve(task, config, settings or {}, constructor.stages if registry.is_task(constructor) else ())
    check_given(task, constructor, recipe.task)
    return recipe


def fill_defaults(recipe: Recipe) -> Recipe:
    """Fill in defaults that depend on other keys: rollout length, normalisation, evaluation interval."""
    kwargs, on_policy = dict(recipe.algo_kwargs), recipe.algo in ON_POLICY
    changes: dict[str, Any] = {"algo_kwargs": kwargs}
    if recipe.algo in ("ppo", "recurrent_ppo"):
        kwargs.setdefault("n_steps", min(max(_DEFAULT_ROLLOUT // recipe.n_envs, 16), 2048))
        kwargs.setdefault("batch_size", min(128, int(kwargs["n_steps"]) * recipe.n_envs))
    if not on_policy:
        # One gradient step per environment step, however many environments there are.
        kwargs.setdefault("gradient_steps", -1)
        kwargs.setdefault("train_freq", 1)
        kwargs.setdefault("buffer_size", min(1_000_000, max(recipe.total_timesteps, 1_000)))
    if recipe.normalize is None:
        changes["normalize"] = NormalizeSettings(observation=on_policy, reward=on_policy or recipe.algo == "xqc")
    if recipe.eval.every_steps is None:
        changes["eval"] = recipe.eval.model_copy(update={"every_steps": max(1, recipe.total_timesteps // 10)})
    return recipe.model_copy(update=changes)


def describe_rounding(recipe: Recipe) -> str | None:
    """Return a note if whole rollouts make the training more than 10 % longer than `total_timesteps`, else None."""
    if recipe.algo not in ON_POLICY:
        return None
    rollout = int(recipe.algo_kwargs.get("n_steps", 5)) * recipe.n_envs
    steps = math.ceil(recipe.total_timesteps / rollout) * rollout
    if steps <= 1.1 * recipe.total_timesteps:
        return None
    return (
        f"training takes {steps:,} steps, not {recipe.total_timesteps:,}: {recipe.algo} needs whole rollouts of "
        f"{rollout:,} steps (n_steps x n_envs)"
    )


def parse_settings(settings: list[str]) -> dict[str, Any]:
    """Parse `--set` texts such as `algo_kwargs.gamma=0.97` into a nested mapping."""
    result: dict[str, Any] = {}
    for text in settings:
        key, equals, value = text.partition("=")
        *path, last = key.strip().split(".")
        if not equals or len(path) >= _DEEPEST_KEY or not all((*path, last)):
            raise RecipeError(f"--set {short_repr(text)!r}: write key=value, for example --set task.tolerance=0.02")
        place = result
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise RecipeError(
                    f"--set {short_repr(text)!r}: an earlier --set gives {part!r} a value, so it cannot have keys"
                )
        place[last] = yaml_text.load(value, f"--set {key}")
    return result


def parse_changes(settings: list[str], sim: Engine | None = None) -> EnvChanges:
    """Parse the `--set` texts that change an environment; raises `RecipeError` for any other key.

    `sim` is the engine of `--sim`, which overrides that of `--set`.
    """
    changes = check_changes(parse_settings(settings), "--set")
    return changes if sim is None else dataclasses.replace(changes, sim=sim)


def check_changes(values: Mapping[str, Any], source: str) -> EnvChanges:
    """Check changes of an environment, given as keys of a recipe; raises `RecipeError` for any other key."""
    for key in values:
        if key not in OF_THE_ENVIRONMENT:
            can = "task.NAME, reward_weights.NAME, randomize, events.NAME and sim can be set here"
            parameter = "" if key in Recipe.model_fields else f"task.{key}"
            raise RecipeError(f"{source} {key}: only {can}.{did_you_mean(key, OF_THE_ENVIRONMENT, parameter)}")
    recipe = validate(values, source)
    randomize = recipe.randomize if "randomize" in values else None
    return EnvChanges(recipe.task, recipe.reward_weights, randomize, recipe.events, recipe.sim or Engine())


def merge_flags(settings: list[str], **flags: Any) -> dict[str, Any]:
    """Return the settings of `--set`, overridden by the flags that are not None; `-n 20k` and `-n 1.5M` are numbers."""
    values = parse_settings(settings)
    if (match := _WITH_UNIT.fullmatch(flags.get("total_timesteps") or "")) is not None:
        flags["total_timesteps"] = f"{match[1]}e{3 if match[2] in 'kK' else 6}"
    for name, value in flags.items():
        if value is not None:
            values[name] = yaml_text.load(value, name) if isinstance(value, str) else value
    return values
