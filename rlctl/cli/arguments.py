"""Arguments and options that several commands share, and what they do first."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlctl.cli import completion

if TYPE_CHECKING:
    from rlctl.environments.spec import EnvChanges

TASK_FORMS = "Installed name, package.module:Class, path/to/file.py:Class, or Gymnasium id."
OptionalTask = Annotated[
    str | None, typer.Argument(metavar="TASK", help=TASK_FORMS, autocompletion=completion.complete_task)
]
Run = Annotated[
    str | None,
    typer.Argument(
        help="Run folder, policy file, task name, or latest.",
        show_default="latest",
        autocompletion=completion.complete_run,
    ),
]
Set = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Set a key, e.g. task.tolerance=0.02, randomize=true.")
]
Config = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Recipe that goes over the task's own, or presets/NAME.")
]
Algo = Annotated[
    str | None,
    typer.Option(
        help="ppo, a2c, sac, td3, ddpg, dqn, tqc, crossq or recurrent_ppo.",
        autocompletion=completion.complete_algorithm,
    ),
]
RunsFolder = Annotated[Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where run folders go.")]
Json = Annotated[str | None, typer.Option("--json", metavar="FILE", help="Write JSON too; - for stdout, alone.")]
EpisodeSeed = Annotated[int, typer.Option(help="Seed of the list of episodes.", min=0)]
EnvTimeout = Annotated[float, typer.Option(metavar="SECONDS", help="How long a step or reset may take.", min=0.1)]
NEnvs = Annotated[int | None, typer.Option(help="Environments stepped side by side.", min=1)]
Checkpoint = Annotated[str, typer.Option(metavar="best|last|STEP", help="Which policy of the run.")]

Pretrained = Annotated[bool, typer.Option("--pretrained", help="The policy that ships with the task.")]


def choose_checkpoint(checkpoint: str, pretrained: bool) -> str:
    """Return which policy was asked for, by `--checkpoint` or by `--pretrained`."""
    if not pretrained:
        return checkpoint
    from rlctl.errors import UsageError
    from rlctl.policy.shipped import PRETRAINED

    if checkpoint not in ("best", PRETRAINED):
        raise UsageError(f"--pretrained is the policy that ships with a task: leave out --checkpoint {checkpoint}")
    return PRETRAINED


def claim_stdout() -> None:
    """Keep stdout for the result: what a plugin prints from now on goes to stderr."""
    from rlctl import output

    output.results()


def parse_changes(settings: list[str]) -> EnvChanges:
    """Read the `--set` options of a command that changes an environment."""
    from rlctl.environments.spec import UNCHANGED

    if not settings:
        return UNCHANGED
    from rlctl.recipe.sources import parse_changes  # takes a quarter of a second

    return parse_changes(settings)
