"""`rlctl train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli import completion
from rlctl.cli.arguments import Algo, Config, EnvTimeout, Json, NEnvs, OptionalTask, RunsFolder, Set, claim_stdout
from rlctl.errors import UsageError


def train(
    task: OptionalTask = None,
    resume: Annotated[
        str | None,
        typer.Option(
            metavar="RUN",
            help="Go on with a run, or with a group of seeds: its folder, a task's name, or latest.",
            autocompletion=completion.complete_run,
        ),
    ] = None,
    initial_policy: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="POLICY",
            help="Begin with a policy: a run, a .safetensors file, or the name of a task that ships one.",
            autocompletion=completion.complete_run,
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Go on with a run even if its task has changed.")] = False,
    config: Config = None,
    settings: Set = [],
    algo: Algo = None,
    seed: Annotated[int | None, typer.Option(help="Seed of everything random.")] = None,
    seeds: Annotated[
        str | None, typer.Option(metavar="0-4", help="Train these seeds, each an ordinary run, as a group.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(help="How many seeds train at a time.", min=1, show_default="half as many as cores")
    ] = None,
    total_timesteps: Annotated[
        str | None, typer.Option("--total-timesteps", "-n", metavar="STEPS", help="Environment steps; 1e6 is fine.")
    ] = None,
    n_envs: NEnvs = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, or auto.")] = "cpu",
    stop_success: Annotated[
        float | None, typer.Option(metavar="RATE", help="Stop after two evaluations in a row at this success rate.")
    ] = None,
    record: Annotated[int, typer.Option(metavar="N", help="Write the last N evaluation episodes as .rrd.", min=0)] = 0,
    no_check: Annotated[bool, typer.Option("--no-check", help="Train without checking the environment first.")] = False,
    env_timeout: EnvTimeout = 60.0,
    output: RunsFolder = Path("runs"),
    json: Json = None,
) -> None:
    """Train a policy, evaluate as it goes, and keep the best and the last."""
    claim_stdout()
    from rlctl.recipe.sources import merge_flags
    from rlctl.run.group import find_group
    from rlctl.training.request import TrainRequest, run_training
    from rlctl.training.summary import show

    group_folder = find_group(resume, output) if resume is not None else None
    request = TrainRequest(
        task=task,
        resume=resume if group_folder is None else str(group_folder),
        config=config,
        settings=merge_flags(
            settings, algo=algo, seed=seed, total_timesteps=total_timesteps, n_envs=n_envs, stop_success=stop_success
        ),
        device=device,
        record=record,
        env_timeout_s=env_timeout,
        root=output,
        check=not no_check,
        force=force,
        initial_policy=initial_policy,
    )
    if seeds is not None or group_folder is not None:
        from rlctl.evaluation import group
        from rlctl.training.seeds import train_seeds

        result = train_seeds(request, seeds, jobs=jobs)
        group.show(result.score, json)
        return result.check()
    if jobs is not None:
        raise UsageError("--jobs is about several seeds: give --seeds 0-4, or --resume GROUP")
    return show(run_training(request), json)
