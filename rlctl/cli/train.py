"""`rlctl train`, `rlctl distill` and `rlctl tune`."""

import dataclasses
from typing import Annotated, Any

from rlctl.arguments import ALGORITHMS, choose_checkpoint, command_in_panels
from rlctl.errors import UsageError
from rlctl.launching.distill_request import DistillRequest
from rlctl.options import Cluster, Jobs, Json, On, Option, Pretrained, Settings, SimOption
from rlctl.runs.train_request import TrainRequest
from rlctl.tuning.tune_request import TuneRequest


@dataclasses.dataclass(frozen=True)
class RecipeFlags:
    """Recipe keys from the command line; a flag overrides `--set`."""

    settings: Settings = dataclasses.field(default_factory=list)
    algo: Annotated[str | None, Option(f"{', '.join(ALGORITHMS[:-1])} or {ALGORITHMS[-1]}.", completes="algorithm")] = (
        None
    )
    seed: Annotated[int | None, Option("Seed of everything random.")] = None
    total_timesteps: Annotated[
        str | None, Option("Environment steps; 1e6 is fine.", ("--total-timesteps", "-n"), metavar="STEPS")
    ] = None
    n_envs: Annotated[int | None, Option("Environments stepped in parallel.", min=1)] = None
    sim: SimOption = None
    track: Annotated[str | None, Option("Also send the run to wandb, mlflow or trackio.", metavar="TRACKER")] = None

    def merge(self) -> dict[str, Any]:
        """Return all keys and values, nested as in a recipe."""
        from rlctl.recipe.sources import merge_flags

        # The settings of a training are plain data: a group and a cluster store them as JSON.
        return merge_flags(**vars(self) | {"sim": None if self.sim is None else str(self.sim)})


def suggest_setting(option: str) -> str | None:
    """Return `--set algo_kwargs.learning_rate=` for `--lr` or `--learning-rate`; None where no recipe has the key."""
    from rlctl.recipe.hyperparameters import ALGORITHM_PARAMETERS
    from rlctl.recipe.recipe import Recipe

    name = option.lstrip("-").replace("-", "_")
    name = {"lr": "learning_rate"}.get(name, name)
    if any(name in parameters.model_fields for parameters in ALGORITHM_PARAMETERS.values()):
        return f"--set algo_kwargs.{name}="
    return f"--set {name}=" if name in Recipe.model_fields else None


@dataclasses.dataclass(frozen=True)
class TrainFlags(RecipeFlags):
    """The keys of a recipe that have a flag of `rlctl train`."""

    stop_success: Annotated[
        float | None, Option("Stop after two evaluations in a row at this success rate.", metavar="RATE")
    ] = None
    callback: Annotated[
        list[str], Option("Call your own class during the training.", ("--callback",), metavar="FILE.py:CLASS")
    ] = dataclasses.field(default_factory=list)

    def merge(self) -> dict[str, Any]:
        """Return all keys and values; the named callbacks come after those of `--set`."""
        from rlctl.environments.spec import merge

        settings = super().merge()
        names = settings.pop("callback")
        return merge(settings, {"callbacks": dict.fromkeys(names)}) if names else settings


@command_in_panels(
    {
        "Options": ["algo", "total_timesteps", "seed", "seeds", "config", "settings", "stop_success"],
        "How": ["sim", "n_envs", "device", "check", "env_timeout_s", "callback"],
        "Continue": ["resume", "initial_policy", "demos", "force"],
        "Where": ["jobs", "on", "cluster", "detach"],
        "Output": ["root", "record", "track", "json"],
    }
)
def train(
    flags: TrainFlags,
    request: TrainRequest,
    seeds: Annotated[str | None, Option("Train a group: one run for each of these seeds.", metavar="0-4")] = None,
    jobs: Jobs = None,
    on: On = None,
    cluster: Cluster = None,
    detach: Annotated[bool, Option("Submit to SLURM and do not wait.", ("--detach",))] = False,
    json: Json = None,
) -> None:
    """Train a policy, evaluate during the training, and save the best and the last policy."""
    from rlctl.runs.group import find_group

    group_folder = find_group(request.resume, request.root) if request.resume is not None else None
    resume = request.resume if group_folder is None else str(group_folder)
    request = dataclasses.replace(request, resume=resume, settings=flags.merge())
    if seeds is not None or group_folder is not None:
        from rlctl import output
        from rlctl.cluster.executors import choose_executor
        from rlctl.evaluation.report import show_group
        from rlctl.launching.seeds import train_seeds
        from rlctl.launching.trainings import Detached

        make_trainings = choose_executor(on, cluster, detach=detach)
        try:
            result = train_seeds(request, seeds, jobs=jobs, make_trainings=make_trainings)
        except Detached as submitted:
            return output.print_notes([str(submitted)])
        show_group(result.score, json)
        return result.check()
    if on is not None or detach or jobs is not None:
        raise UsageError("--jobs, --on and --detach need several seeds: give --seeds 0-4 or --resume GROUP")
    from rlctl.launching.train import run_training, show

    return show(run_training(request), json)


@dataclasses.dataclass(frozen=True)
class DistillFlags(RecipeFlags):
    """The keys of a student's recipe that have a flag of `rlctl distill`."""

    algo: Annotated[str | None, Option("ppo, a2c or recurrent_ppo.", completes="algorithm")] = None
    total_timesteps: Annotated[
        str | None,
        Option(
            "Environment steps with the teacher.",
            ("--total-timesteps", "-n"),
            metavar="STEPS",
            default_text="a quarter of the recipe's",
        ),
    ] = None


@command_in_panels(
    {
        "Options": ["observe", "settings", "total_timesteps", "then_ppo", "algo", "seed"],
        "Teacher": ["checkpoint", "pretrained"],
        "How": ["sim", "n_envs", "device", "check", "env_timeout_s"],
        "Output": ["root", "track", "json"],
    }
)
def distill(flags: DistillFlags, request: DistillRequest, pretrained: Pretrained = False, json: Json = None) -> None:
    """Train a student with other observations from a policy's actions (DAgger), and compare it with its teacher."""
    from rlctl.launching.distill import distill as run_distilling
    from rlctl.launching.distill import show

    checkpoint = choose_checkpoint(request.checkpoint, pretrained)
    request = dataclasses.replace(request, checkpoint=checkpoint, settings=flags.merge())
    return show(run_distilling(request), json)


@dataclasses.dataclass(frozen=True)
class TuneFlags(RecipeFlags):
    """The keys of a recipe that have a flag of `rlctl tune`."""

    seed: Annotated[int | None, Option("Seed of the first trial; trial n has seed + n.")] = None
    total_timesteps: Annotated[
        str | None, Option("Environment steps of a trial.", ("--total-timesteps", "-n"), metavar="STEPS")
    ] = None


@command_in_panels(
    {
        "Options": ["algo", "total_timesteps", "seed", "config", "settings", "sim", "n_envs"],
        "Search": ["search", "trials", "metric"],
        "Continue": ["resume", "storage"],
        "Where": ["jobs", "on", "cluster"],
        "Output": ["root", "track", "json"],
    }
)
def tune(
    flags: TuneFlags, request: TuneRequest, jobs: Jobs = None, on: On = None, cluster: Cluster = None, json: Json = None
) -> None:
    """Find hyperparameters: the learning rate, then rollout and minibatch, then the discount, with Optuna."""
    from rlctl.cluster.executors import choose_executor
    from rlctl.tuning.tune import tune as run_tuning
    from rlctl.tuning.tuning import show

    request = dataclasses.replace(request, settings=flags.merge())
    return show(run_tuning(request, jobs=jobs, make_trainings=choose_executor(on, cluster, verb="tune")), json)
