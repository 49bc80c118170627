"""`rlctl tune`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import Algo, Config, Json, NEnvs, OptionalTask, RunsFolder, Set, claim_stdout
from rlctl.errors import UsageError


def tune(
    task: OptionalTask = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Go on with a tuning that was interrupted.")
    ] = None,
    search: Annotated[
        list[str],
        typer.Option(
            metavar="KEY=LOW:HIGH",
            help="Search this key, or KEY=A,B,C; repeat it for more, searched together.",
            show_default="learning rate; then n_steps and batch_size; then gamma",
        ),
    ] = [],
    trials: Annotated[int, typer.Option(help="Trainings per step of the search, at most.", min=1, max=1000)] = 8,
    metric: Annotated[str, typer.Option(metavar="return|success", help="What to maximise.")] = "return",
    jobs: Annotated[
        int | None, typer.Option(help="How many train at a time.", min=1, show_default="half as many as cores")
    ] = None,
    config: Config = None,
    settings: Set = [],
    algo: Algo = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the first trial; the others have the next ones.")] = None,
    total_timesteps: Annotated[
        str | None, typer.Option("--total-timesteps", "-n", metavar="STEPS", help="Environment steps of a trial.")
    ] = None,
    n_envs: NEnvs = None,
    output: RunsFolder = Path("runs"),
    json: Json = None,
) -> None:
    """Find hyperparameters: the learning rate, then rollout and minibatch, then the discount, with Optuna."""
    claim_stdout()
    if (task is None) == (resume is None):
        raise UsageError("give a task to tune, or --resume FOLDER")
    if metric not in ("return", "success"):
        raise UsageError(f"--metric {metric}: give return or success")
    from rlctl.recipe.sources import merge_flags
    from rlctl.tuning import report
    from rlctl.tuning.tune import TuneRequest
    from rlctl.tuning.tune import resume as go_on
    from rlctl.tuning.tune import tune as begin

    if resume is not None:
        return report.show(go_on(resume, jobs=jobs), json)
    assert task is not None
    flags = merge_flags(settings, algo=algo, seed=seed, total_timesteps=total_timesteps, n_envs=n_envs)
    request = TuneRequest(task, config, flags, search, trials, metric, output)  # type: ignore[arg-type]
    return report.show(begin(request, jobs=jobs), json)
