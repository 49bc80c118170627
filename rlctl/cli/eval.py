"""`rlctl eval`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlctl.cli.arguments import (
    Checkpoint,
    EnvTimeout,
    EpisodeSeed,
    Json,
    NEnvs,
    Pretrained,
    Run,
    Set,
    choose_checkpoint,
    claim_stdout,
    parse_changes,
)
from rlctl.errors import UsageError


def evaluate(
    run: Run = None,
    task: Annotated[
        str | None, typer.Option(help="Evaluate on this task instead of the one it was trained on.")
    ] = None,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    policy: Annotated[
        str | None,
        typer.Option(
            metavar="zero|random|FUNCTION|ws://HOST:PORT",
            help="Play on a TASK: zero, random, MODULE:FUNCTION, PATH.py:FUNCTION, or a policy server.",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Episodes, each with its own seed.", min=1)] = 100,
    seed: EpisodeSeed = 0,
    stage: Annotated[
        int | None, typer.Option(help="Stage of the curriculum it was trained in.", min=1, show_default="the last")
    ] = None,
    settings: Set = [],
    stochastic: Annotated[
        bool, typer.Option("--stochastic", help="Sample actions instead of taking the mean.")
    ] = False,
    n_envs: NEnvs = None,
    min_success: Annotated[
        float | None, typer.Option(metavar="RATE", help="Gate: exit 1 below this success rate.")
    ] = None,
    min_success_lower: Annotated[
        float | None, typer.Option(metavar="RATE", help="Gate on the lower bound of the 95 % interval.")
    ] = None,
    min_return: Annotated[
        float | None, typer.Option(metavar="RETURN", help="Gate: exit 1 below this mean return.")
    ] = None,
    limits: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Say what these safety limits (YAML) cost, and how often they act."),
    ] = None,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=LOW:HIGH:COUNT|all",
            help="Map over an event or parameter of the task, e.g. mass=0.6:1.4:9; twice for two together.",
        ),
    ] = [],
    push: Annotated[bool, typer.Option("--push", help="Find from which push on it fails.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a long --vary.")] = False,
    env_timeout: EnvTimeout = 60.0,
    json: Json = None,
) -> None:
    """Say how good a policy is: success rate with its interval, returns, reward terms."""
    claim_stdout()
    from rlctl.evaluation.evaluate import EvalRequest, Gates, run_evaluation
    from rlctl.evaluation.report import show
    from rlctl.run.directory import is_group
    from rlctl.run.group import read_group

    gates = Gates(min_success, min_success_lower, min_return)
    request = EvalRequest(
        run=run,
        task=task,
        checkpoint=choose_checkpoint(checkpoint, pretrained),
        baseline=policy,
        episodes=episodes,
        seed=seed,
        changes=parse_changes(settings),
        stage=stage,
        deterministic=not stochastic,
        n_envs=n_envs,
        env_timeout_s=env_timeout,
        limits=limits,
    )
    if vary or push:
        if policy is not None or limits is not None:
            given = "--limits" if policy is None else "--policy"
            raise UsageError(f"{given} plays a task as it is: leave out --vary and --push")
        from rlctl.evaluation import robustness_report
        from rlctl.evaluation.vary import check_gates, measure_robustness

        robustness = measure_robustness(request, vary, push=push, yes=yes, gates=gates)
        robustness_report.show(robustness, json)
        return check_gates(robustness, gates)
    if run is not None and policy is None and is_group(Path(run)):
        from rlctl.evaluation import group

        scores = group.evaluate_group(read_group(Path(run)), request)
        group.show(scores, json)
        return scores.check(gates)
    result = run_evaluation(request, gates)
    show(result, json)
    return gates.check(result)
