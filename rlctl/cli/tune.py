"""`rlctl tune`."""

import dataclasses
from typing import Annotated

from rlctl.cli.arguments import RecipeFlags, command
from rlctl.options import Cluster, Jobs, Json, On, Option
from rlctl.tuning.tune_request import TuneRequest


@dataclasses.dataclass(frozen=True)
class TuneFlags(RecipeFlags):
    """The keys of a recipe that have a flag of `rlctl tune`."""

    seed: Annotated[int | None, Option("Seed of the first trial; trial n has seed + n.")] = None
    total_timesteps: Annotated[
        str | None, Option("Environment steps of a trial.", ("--total-timesteps", "-n"), metavar="STEPS")
    ] = None


@command
def tune(
    flags: TuneFlags, request: TuneRequest, jobs: Jobs = None, on: On = None, cluster: Cluster = None, json: Json = None
) -> None:
    """Find hyperparameters: the learning rate, then rollout and minibatch, then the discount, with Optuna."""
    from rlctl.cluster.executors import choose_executor
    from rlctl.tuning import report
    from rlctl.tuning.tune import tune as run_tuning

    request = dataclasses.replace(request, settings=flags.merge())
    return report.show(run_tuning(request, jobs=jobs, make_trainings=choose_executor(on, cluster, verb="tune")), json)
