"""Recipes: how to train a task. Typed YAML, every key is checked; `rlctl.recipe.sources` merges their sources."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import pydantic
from pydantic import Field

from rlctl.engine import Engine
from rlctl.environments.spec import EnvSpec, merge
from rlctl.errors import RecipeError, short_repr
from rlctl.recipe.hyperparameters import ALGORITHM_PARAMETERS, decide_by
from rlctl.recipe.hyperparameters import ON_POLICY as ON_POLICY
from rlctl.recipe.network_parameters import NETWORK_PARAMETERS
from rlctl.recipe.stages import FollowingLevel, Stage, check_promotions
from rlctl.storage import validation, yaml_text
from rlctl.storage.validation import Number, Section, Switch, Whole

Algorithm = Literal["ppo", "a2c", "sac", "td3", "ddpg", "dqn", "tqc", "crossq", "xqc", "recurrent_ppo"]
ALGORITHMS: tuple[str, ...] = get_args(Algorithm)
IN_HINDSIGHT: tuple[Algorithm, ...] = ("sac", "td3", "ddpg", "dqn", "tqc", "xqc")
"""Algorithms with hindsight replay: those with a replay buffer, except crossq, which has no network for Dict spaces."""

WITH_PRIVILEGED: tuple[Algorithm, ...] = ("ppo", "a2c", "recurrent_ppo", "sac", "tqc", "xqc")
"""Algorithms whose critic may see more than the actor."""

SCHEMA_FILE = Path(__file__).with_name("recipe.schema.json")
"""The JSON schema of recipes for editors; `docs/generate.py` writes it."""

NOT_SET = "(not set)"
"""Stands for a missing key in the result of `find_difference`."""
_QUANTILES = 25  # default per critic
_MOST_STEPS = 10**12
_MOST_ENVS = 10_000


class NormalizeSettings(Section):
    """Running normalisation, as SB3's VecNormalize does it."""

    observation: Switch = True
    """Whether to normalise observations."""
    reward: Switch = True
    """Whether to divide rewards by the standard deviation of the return."""
    clip_observation: Number = Field(10.0, gt=0)
    """Bound of normalised observations."""
    clip_reward: Number = Field(10.0, gt=0)
    """Bound of normalised rewards."""


class EvalSettings(Section):
    """Evaluation while training; steps are environment steps, all environments together."""

    every_steps: Whole | None = Field(
        None, ge=1, le=_MOST_STEPS, json_schema_extra=decide_by("a tenth of total_timesteps")
    )
    """Steps between evaluations."""
    episodes: Whole = Field(20, ge=1, le=1_000_000)
    """Episodes per evaluation, the same seeds each time."""
    seed: Whole | None = Field(None, ge=0, lt=2**32, json_schema_extra=decide_by("the seed of the training"))
    """Seed of these episodes. Trainings with different seeds and equal episodes can be compared."""
    deterministic: Switch = True
    """Whether the policy takes its mean action instead of a random sample."""


class Hindsight(Section):
    """Hindsight experience replay, by the names of SB3's `HerReplayBuffer`; see `rlctl.training.off_policy`."""

    n_sampled_goal: Whole = Field(4, ge=1, le=1000)
    """Relabelled transitions per real transition."""
    goal_selection_strategy: Literal["future", "final", "episode"] = "future"
    """Which of the goals that the episode reached later replace the desired goal."""


class PrivilegedSettings(Section):
    """What the critic sees besides the actor's observation, in training only."""

    task: Switch = True
    """Whether it sees what the task names in `privileged()`."""
    events: Switch = True
    """Whether it sees the values that the acting events drew, such as a mass or a push."""


class CheckpointSettings(Section):
    """Which checkpoints are kept."""

    keep: Whole = Field(3, ge=1, le=1_000_000)
    """Number of newest checkpoints that are kept."""


class Recipe(Section):
    """How to train a task. `algo_kwargs` and `policy_kwargs` are SB3's own names."""

    task: dict[str, Any] = {}
    """Parameters of the task: the arguments of its constructor."""
    reward_weights: dict[str, Number] = {}
    """Weights of reward terms that differ from the task's defaults."""
    randomize: Switch = False
    """Whether all of the task's events (random changes) act."""
    events: dict[str, dict[str, Any]] = {}
    """Events (random changes) that act, by name, with the parameters that differ from the task's defaults."""
    sim: Engine | None = Field(None, json_schema_extra=decide_by("pybullet if it is installed, else mujoco"))
    """Physics engine of a task: pybullet, mujoco, or mujoco:0.01 with the time constant of contacts [s]."""
    algo: Algorithm = "ppo"
    """The algorithm."""
    algo_kwargs: dict[str, Any] = {}
    """Parameters of the algorithm; see its own table."""
    policy_kwargs: dict[str, Any] = {}
    """Parameters of the networks; see the algorithm's own table."""
    her: Hindsight | None = None
    """Hindsight experience replay, for tasks with goals; null: off."""
    privileged: PrivilegedSettings | None = None
    """A critic that sees more than the actor, for tasks with flat observations; null: it sees the same."""
    mirror: Switch = False
    """PPO: whether to learn from the mirror image of every step too, for tasks that declare their symmetry."""
    mirror_loss: float = Field(0.0, ge=0, le=1e6)
    """PPO: weight of the squared difference between a mirror image's mean action and the mirrored mean action."""
    normalize: NormalizeSettings | None = Field(
        None, json_schema_extra=decide_by("both for ppo, a2c, recurrent_ppo; rewards for xqc; else neither")
    )
    """Running normalisation of observations and rewards."""
    frame_stack: Whole = Field(1, ge=1, le=1000)
    """Number of latest observations that the policy gets, stacked."""
    observe: list[str] = []
    """What the policy observes, by names of the task's `observe`, `privileged` or cameras; empty: all of `observe`."""
    observation_history: dict[str, Annotated[Whole, Field(ge=1, le=1000)]] = {}
    """Number of last values of observations that become histories, by name; `frame_stack` stacks all."""
    time_feature: Switch = False
    """Whether the policy also observes the remaining fraction of the episode, from 1 to 0, as rl-zoo3's agents do."""
    overlap: Switch = True
    """Off-policy: whether environments play during an update; their policy is then one chunk (`train_freq`) older."""
    n_envs: Whole = Field(8, ge=1, le=_MOST_ENVS)
    """Number of parallel environments."""
    mixed_ages: Switch = False
    """Whether the first episode of each environment has a random length, so that later ones do not end all at once."""
    total_timesteps: Whole = Field(300_000, ge=1, le=_MOST_STEPS)
    """Environment steps, all environments together."""
    seed: Whole = Field(0, ge=0, lt=2**32)
    """Seed of all random numbers."""
    eval: EvalSettings = EvalSettings()
    """Evaluation while training."""
    stop_success: Number | None = Field(None, gt=0, le=1)
    """Stop after two evaluations in a row at this success rate; null: never."""
    checkpoint: CheckpointSettings = CheckpointSettings()
    """Which checkpoints are kept."""
    callbacks: dict[str, dict[str, Any] | None] = {}
    """Callbacks: your own classes, as `FILE.py:CLASS` or `MODULE:CLASS`, and their arguments; see docs/callbacks.md."""
    track: Literal["wandb", "mlflow", "trackio"] | None = None
    """Experiment tracker that also gets metrics, policy, report and film; null: none."""
    stages: Annotated[list[Stage], pydantic.AfterValidator(check_promotions)] = []
    """Curriculum: what each stage changes, and when it ends."""

    @pydantic.field_validator("algo_kwargs", "policy_kwargs")
    @classmethod
    def _check_parameters(cls, values: dict[str, Any], info: pydantic.ValidationInfo) -> dict[str, Any]:
        models = ALGORITHM_PARAMETERS if info.field_name == "algo_kwargs" else NETWORK_PARAMETERS
        model = models.get(info.data.get("algo", ""))  # not there if it is wrong itself, which is then reported
        if model is None:
            return values
        return model.model_validate(values).model_dump(mode="json", exclude_unset=True)

    @pydantic.model_validator(mode="after")
    def _fit_together(self) -> Self:
        dropped = self.algo_kwargs.get("top_quantiles_to_drop_per_net", 0)
        if dropped >= (quantiles := self.policy_kwargs.get("n_quantiles", _QUANTILES)):
            raise ValueError(
                f"algo_kwargs.top_quantiles_to_drop_per_net: {dropped} of {quantiles} quantiles are dropped, so none "
                "remains; it must be below policy_kwargs.n_quantiles"
            )
        return self

    @pydantic.field_validator("her")
    @classmethod
    def _check_replay(cls, value: Hindsight | None, others: pydantic.ValidationInfo) -> Hindsight | None:
        algo = others.data.get("algo")
        if value is not None and algo is not None and algo not in IN_HINDSIGHT:
            raise ValueError(f"{algo} does not support hindsight replay; {', '.join(IN_HINDSIGHT)} do")
        return value

    @pydantic.field_validator("privileged")
    @classmethod
    def _check_critic(
        cls, value: PrivilegedSettings | None, others: pydantic.ValidationInfo
    ) -> PrivilegedSettings | None:
        algo = others.data.get("algo")
        if value is not None and algo is not None and algo not in WITH_PRIVILEGED:
            raise ValueError(
                f"{algo} has no critic that may see more than its actor; {', '.join(WITH_PRIVILEGED)} have"
            )
        return value

    def env_specs(self, task: str, named_by: str = "") -> list[EnvSpec]:
        """Return the `EnvSpec` of each stage; a list of one for a recipe without stages.

        `named_by` is the kind of file that names the task; empty if the user named it.
        """
        base = EnvSpec(
            task,
            self.task,
            self.reward_weights,
            self.randomize,
            self.events,
            self.frame_stack,
            self.time_feature,
            tuple(self.observe),
            self.observation_history,
            sim=self.sim or Engine(),
            named_by=named_by,
        )
        return [
            dataclasses.replace(
                base,
                parameters=merge(self.task, stage.task),
                reward_weights={**self.reward_weights, **stage.reward_weights},
                events=merge(self.events, stage.events),
                stage=number,
                level=1.0 if isinstance(stage.level, FollowingLevel) else stage.level,
            )
            for number, stage in enumerate(self.stages, start=1)
        ] or [base]

    def to_yaml(self) -> str:
        """Return the recipe as YAML that is itself valid for `--config`."""
        return yaml_text.dump(self.model_dump(mode="json", by_alias=True))


@dataclasses.dataclass(frozen=True)
class Source:
    """Values of a recipe, and their source."""

    name: str  # empty for the command line and for function arguments, which errors need not name
    values: Mapping[str, Any]
    file: Path | None = None

    def find(self, path: Sequence[str | int]) -> str | None:
        """Return the source of the value at `path`, with the line of a file; None if it is not in this source."""
        value: Any = self.values
        for part in path:
            if not (isinstance(value, Mapping) and part in value) and not (isinstance(part, int) and value):
                return None
            value = value[part]
        return self.name if self.file is None else f"{self.file}:{yaml_text.find_line(self.file.read_text(), path)}"


def validate(values: Mapping[str, Any], *sources: Source | str) -> Recipe:
    """Check plain data; raises `RecipeError` that names each wrong key, what was expected, and the closest name.

    `sources` are in order of precedence; the error names the first one that has the key.
    """
    try:
        return Recipe.model_validate(values)
    except pydantic.ValidationError as error:
        schema = build_schema(str(values.get("algo", "ppo")))

        def explain(problem: Any, path: validation.Place) -> str:
            origins = (source if isinstance(source, str) else source.find(path) for source in sources)
            origin = next((origin for origin in origins if origin is not None), "recipe")
            return (f"{origin}: " if origin else "") + _explain(problem, path, schema, values)

        raise RecipeError(validation.explain_all(error, schema, explain)) from None


@functools.cache
def build_schema(algo: str | None = None) -> validation.Schema:
    """Return the JSON schema of a recipe, with the parameters of `algo` and its networks; do not modify it."""
    schema = Recipe.model_json_schema()
    _add_descriptions(schema, Recipe)
    for key, models in (("algo_kwargs", ALGORITHM_PARAMETERS), ("policy_kwargs", NETWORK_PARAMETERS)):
        if algo in models:
            own = models[algo].model_json_schema()
            _add_descriptions(own, models[algo])
            schema["$defs"] |= own.pop("$defs", {})
            schema["properties"][key] |= own
    return schema


def _add_descriptions(schema: validation.Schema, model: type[Section]) -> None:
    """Add the descriptions that pydantic leaves out: those of the overridden field, or equal to the type's own."""
    for name, part in schema["properties"].items():
        classes = [cls for cls in model.__mro__ if issubclass(cls, Section) and name in cls.model_fields]
        if "description" not in part:
            part["description"] = next((text for cls in classes if (text := cls.model_fields[name].description)), "")


def _explain(problem: Any, path: Sequence[str | int], schema: validation.Schema, values: Mapping[str, Any]) -> str:
    where, shown = "", path
    if len(path) > 1 and path[0] == "stages":
        where, shown = f"stage {int(path[1]) + 1}: ", path[2:]
    key = ".".join(short_repr(str(part)) for part in shown)
    of = f" for {values.get('algo', 'ppo')}" if path and path[0] in ("algo_kwargs", "policy_kwargs") else ""
    parameter = f"task.{key}" if len(path) == 1 else ""  # users forget the section of a task's parameters
    return where + validation.explain(problem, path, schema, values, key=key, of=of, otherwise=parameter)


def find_difference(recipe: Recipe, base: Recipe) -> dict[str, tuple[Any, Any]]:
    """Return the dotted keys that differ except `seed` and `track`, each with its value in `recipe` and in `base`.

    A hyperparameter that is not set has its default.
    """
    ours, theirs = (dict(flatten(one.model_dump(mode="json", by_alias=True))) for one in (recipe, base))
    keys = [key for key in dict.fromkeys([*theirs, *ours]) if key not in ("seed", "track")]
    pairs = {key: (_find_effective(recipe, ours, key), _find_effective(base, theirs, key)) for key in keys}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}


def _find_effective(recipe: Recipe, values: Mapping[str, Any], key: str) -> Any:
    section, _, name = key.partition(".")
    if key in values or section != "algo_kwargs":
        return values.get(key, NOT_SET)
    field = ALGORITHM_PARAMETERS[recipe.algo].model_fields.get(name)
    return NOT_SET if field is None else field.default


def fill_parameters(recipe: Recipe) -> dict[str, Any]:
    """Return the parameters of a recipe's algorithm, with the defaults of those that it leaves out."""
    return ALGORITHM_PARAMETERS[recipe.algo].model_validate(recipe.algo_kwargs).model_dump()


def find_mixed(recipes: Sequence[Recipe]) -> list[str]:
    """Return the dotted keys in which the recipes differ."""
    return sorted({key for recipe in recipes[1:] for key in find_difference(recipe, recipes[0])})


def flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and their values: `algo_kwargs.gamma`."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{prefix}{key}.")
        elif value != {}:
            yield prefix + key, value
