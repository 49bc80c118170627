"""Recipes: how to train a task. YAML, typed, every key checked.

A recipe is made from the task's packaged YAML, then `--config`, then `--set` and the command line's own flags.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import pydantic
from pydantic import Field

from rlctl import registry
from rlctl.env_spec import EnvSpec
from rlctl.errors import ArtifactError, RecipeError, did_you_mean, short_repr
from rlctl.run import untrusted, yaml_text
from rlctl.run.hyperparameters import ON_POLICY as ON_POLICY
from rlctl.run.hyperparameters import check_algorithm, check_policy, check_together
from rlctl.run.quantities import Number, Switch, Whole
from rlctl.run.stages import Promotion, Stage, check_promotions

Algorithm = Literal["ppo", "a2c", "sac", "td3", "ddpg", "dqn", "tqc", "crossq", "recurrent_ppo"]
ALGORITHMS: tuple[str, ...] = get_args(Algorithm)
IN_HINDSIGHT: tuple[Algorithm, ...] = ("sac", "td3", "ddpg", "dqn", "tqc")
"""What can learn in hindsight: what has a replay buffer, except crossq, which has no network for Dict spaces."""

_DEEPEST_KEY = 20
_LONGEST = 2**20  # [bytes] of a recipe file
_DEFAULT_ROLLOUT = 4096  # [steps], all environments together


_MOST_STEPS = 10**12
_MOST_ENVS = 10_000


class _Section(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Normalize(_Section):
    """Running normalisation, as SB3's VecNormalize does it."""

    observation: Switch = True
    reward: Switch = True
    clip_observation: Number = Field(10.0, gt=0)
    clip_reward: Number = Field(10.0, gt=0)


class Evaluation(_Section):
    """Evaluation while training; steps are environment steps, all environments together."""

    every_steps: Whole | None = Field(None, ge=1, le=_MOST_STEPS)
    episodes: Whole = Field(100, ge=1, le=1_000_000)
    deterministic: Switch = True
    """Whether to take the mean action, and not a sample."""


class Hindsight(_Section):
    """Hindsight experience replay, by the names of SB3's `HerReplayBuffer`; see `rlctl.train.hindsight`."""

    n_sampled_goal: Whole = Field(4, ge=1, le=1000)
    goal_selection_strategy: Literal["future", "final", "episode"] = "future"


class Checkpoints(_Section):
    keep: Whole = Field(3, ge=1, le=1_000_000)


class Recipe(_Section):
    """How to train a task. `algo_kwargs` and `policy_kwargs` are SB3's own names."""

    task: dict[str, Any] = {}
    reward_weights: dict[str, Number] = {}
    randomize: Switch = False
    events: dict[str, dict[str, Any]] = {}
    algo: Algorithm = "ppo"
    algo_kwargs: dict[str, Any] = {}
    policy_kwargs: dict[str, Any] = {}
    her: Hindsight | None = None
    normalize: Normalize | None = None
    frame_stack: Whole = Field(1, ge=1, le=1000)
    n_envs: Whole = Field(8, ge=1, le=_MOST_ENVS)
    total_timesteps: Whole = Field(300_000, ge=1, le=_MOST_STEPS)
    seed: Whole = Field(0, ge=0, lt=2**32)
    eval: Evaluation = Evaluation()
    stop_success: Number | None = Field(None, gt=0, le=1)
    checkpoint: Checkpoints = Checkpoints()
    stages: list[Stage] = []

    @pydantic.field_validator("algo_kwargs", "policy_kwargs")
    @classmethod
    def _in_range(cls, values: dict[str, Any], info: pydantic.ValidationInfo) -> dict[str, Any]:
        check = check_algorithm if info.field_name == "algo_kwargs" else check_policy
        check(info.data.get("algo", "ppo"), values)
        return values

    @pydantic.model_validator(mode="after")
    def _fit_together(self) -> Recipe:
        check_together(self.algo, self.algo_kwargs, self.policy_kwargs, self.n_envs)
        return self

    @pydantic.field_validator("her")
    @classmethod
    def _has_replay(cls, value: Hindsight | None, others: pydantic.ValidationInfo) -> Hindsight | None:
        algo = others.data.get("algo")  # not there if it is wrong itself, which is then told
        if value is not None and algo is not None and algo not in IN_HINDSIGHT:
            raise ValueError(f"{algo} cannot learn in hindsight; {', '.join(IN_HINDSIGHT)} can")
        return value

    @pydantic.field_validator("stages")
    @classmethod
    def _end_in_turn(cls, values: list[Stage]) -> list[Stage]:
        check_promotions(values)
        return values

    def env_specs(self, task: str, named_by: str = "") -> list[EnvSpec]:
        """Return what environments are made from, stage by stage; of a recipe without stages a list of one.

        `named_by` is the kind of file that names the task, if no person does.
        """
        base = EnvSpec(
            task, self.task, self.reward_weights, self.randomize, self.events, self.frame_stack, named_by=named_by
        )
        return [
            dataclasses.replace(
                base,
                parameters=merge(self.task, stage.task),
                reward_weights={**self.reward_weights, **stage.reward_weights},
                events=merge(self.events, stage.events),
                stage=number,
                level=stage.level,
            )
            for number, stage in enumerate(self.stages, start=1)
        ] or [base]

    def to_yaml(self) -> str:
        """Return the recipe as YAML that is itself valid for `--config`."""
        return yaml_text.dump(self.model_dump(mode="json", by_alias=True))


def read(path: Path) -> dict[str, Any]:
    """Read a recipe file as plain data, unchecked."""
    if not path.exists():
        raise ArtifactError(f"no recipe file {path}")
    try:
        text = untrusted.read_bytes(path, _LONGEST).decode()
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start:,}; save it as UTF-8") from None
    return _mapping(yaml_text.load(text, str(path)), path)


def _mapping(content: Any, path: Path) -> dict[str, Any]:
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise RecipeError(f"{path}: a recipe is a mapping of keys to values, this is a {type(content).__name__}")
    return content


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


def resolve(
    task: str, config: Path | None, settings: Mapping[str, Any], stages: Sequence[Mapping[str, Any]] = ()
) -> Recipe:
    """Merge the packaged recipe, `--config` and the command line's settings, and check every key.

    `stages` are those that the task's class declares; a recipe that has the key replaces them.
    """
    packaged_file = registry.find_recipe_file(task)
    packaged = read(packaged_file) if packaged_file else {}
    given = merge(read(config) if config else {}, settings)
    algo = given.get("algo", packaged.get("algo", "ppo"))
    if packaged.get("algo", "ppo") != algo:
        # Hyperparameters of another algorithm would be wrong here, and so would its number of environments.
        packaged = {k: v for k, v in packaged.items() if k not in _OF_THE_ALGORITHM}
    merged = merge(packaged, given)
    if stages and "stages" not in merged:
        merged["stages"] = validate({"stages": list(stages)}, f"class of {task}").model_dump(by_alias=True)["stages"]
    source = "recipe" if not config else f"recipe {config}"
    return fill_defaults(validate(merged, source))


_OF_THE_ALGORITHM = ("algo", "algo_kwargs", "policy_kwargs", "her", "normalize", "n_envs", "total_timesteps")


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return `below` with the values of `above` put over it, mapping by mapping."""
    result = dict(below)
    for key, value in above.items():
        known = result.get(key)
        both = isinstance(known, Mapping) and isinstance(value, Mapping)
        result[key] = merge(known, value) if both else value  # type: ignore[arg-type]
    return result


def validate(values: Mapping[str, Any], source: str) -> Recipe:
    """Check plain data; raises `RecipeError` that names the key, what was expected, and the closest name."""
    try:
        return Recipe.model_validate(values)
    except pydantic.ValidationError as error:
        raise RecipeError(f"{source}: {_explain(error.errors()[0])}") from None


def _explain(problem: Any) -> str:
    path = [short_repr(str(part)) for part in problem["loc"]]
    where = ""
    if path[:1] == ["stages"] and len(path) > 1:
        where, path = f"stage {problem['loc'][1] + 1}: ", path[2:]
    key = ".".join(path)
    if problem["type"] == "extra_forbidden":
        section = _SECTIONS.get(path[-2], Recipe) if len(path) > 1 else Stage if where else Recipe
        names = [field.alias or name for name, field in section.model_fields.items()]
        return f"{where}no key {key!r}.{did_you_mean(path[-1], names)} Keys here: {', '.join(names)}."
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if problem["type"] == "value_error":
        between = "." if key in ("algo_kwargs", "policy_kwargs") else ": " if key else ""
        return f"{where}{key}{between}{message}"
    given = repr(problem["input"]) if isinstance(problem["input"], str) else problem["input"]
    return f"{where}{key + ': ' if key else ''}{message}, got {short_repr(given)}"


_SECTIONS: dict[str, type[pydantic.BaseModel]] = {
    "her": Hindsight,
    "normalize": Normalize,
    "eval": Evaluation,
    "checkpoint": Checkpoints,
    "promote": Promotion,
}


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
        changes["normalize"] = Normalize(observation=on_policy, reward=on_policy)
    if recipe.eval.every_steps is None:
        changes["eval"] = recipe.eval.model_copy(update={"every_steps": max(1, recipe.total_timesteps // 10)})
    return recipe.model_copy(update=changes)


def parse_task_settings(settings: list[str]) -> dict[str, Any]:
    """Return the constructor arguments in `--set task.key=value`; raises `RecipeError` for any other key."""
    values = parse_settings(settings)
    for key in values:
        if key != "task":
            raise RecipeError(f"--set {key}: only task.* can be set here.{did_you_mean(key, ['task'])}")
    parameters = values.get("task", {})
    if not isinstance(parameters, dict):
        raise RecipeError("--set task: write task.key=value")
    return parameters


def merge_flags(settings: list[str], **flags: Any) -> dict[str, Any]:
    """Return the settings of `--set` with those of the flags that were given put over them."""
    values = parse_settings(settings)
    for name, value in flags.items():
        if value is not None:
            values[name] = yaml_text.load(value, name) if isinstance(value, str) else value
    return values
