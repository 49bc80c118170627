"""`rlctl train`."""

import dataclasses
from typing import Annotated, Any

from rlctl.cli.arguments import RecipeFlags, command
from rlctl.errors import UsageError
from rlctl.options import Cluster, Jobs, Json, On, Option
from rlctl.run.train_request import TrainRequest


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


@command
def train(
    flags: TrainFlags,
    request: TrainRequest,
    seeds: Annotated[str | None, Option("Train these seeds, each an ordinary run, as a group.", metavar="0-4")] = None,
    jobs: Jobs = None,
    on: On = None,
    cluster: Cluster = None,
    detach: Annotated[bool, Option("Submit to SLURM and do not wait.", ("--detach",))] = False,
    json: Json = None,
) -> None:
    """Train a policy, evaluate during the training, and save the best and the last policy."""
    from rlctl.run.group import find_group

    group_folder = find_group(request.resume, request.root) if request.resume is not None else None
    resume = request.resume if group_folder is None else str(group_folder)
    request = dataclasses.replace(request, resume=resume, settings=flags.merge())
    if seeds is not None or group_folder is not None:
        from rlctl import output
        from rlctl.cluster.executors import choose_executor
        from rlctl.evaluation.report import show_group
        from rlctl.training.seeds import train_seeds
        from rlctl.training.trainings import Detached

        make_trainings = choose_executor(on, cluster, detach=detach)
        try:
            result = train_seeds(request, seeds, jobs=jobs, make_trainings=make_trainings)
        except Detached as submitted:
            return output.print_notes([str(submitted)])
        show_group(result.score, json)
        return result.check()
    if on is not None or detach:
        raise UsageError("--on and --detach need several seeds: give --seeds 0-4 or --resume GROUP")
    if jobs is not None:
        raise UsageError("--jobs needs several seeds: give --seeds 0-4 or --resume GROUP")
    from rlctl.training.request import run_training
    from rlctl.training.summary import show

    return show(run_training(request), json)
