"""`rlctl replay`."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from rlctl.cli import completion
from rlctl.cli.arguments import (
    Checkpoint,
    EpisodeSeed,
    Json,
    Pretrained,
    Set,
    choose_checkpoint,
    claim_stdout,
    parse_changes,
)

if TYPE_CHECKING:
    from rlctl.replaying.replay import Choice

_BY_OUTCOME = ("--worst", "--best", "--failures")


class ReplayCommand(TyperCommand):
    """Reads `--best RUN` as `--best 1 RUN`, and so for the other options that choose episodes by outcome."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the missing counts, then parse as Typer does."""
        return super().parse_args(ctx, list(_fill_counts(args)))


def _fill_counts(arguments: Iterable[str]) -> Iterator[str]:
    for argument, following in itertools.pairwise([*arguments, ""]):
        yield argument
        # Only a number is the option's own: anything else after it may be the run.
        if argument in _BY_OUTCOME and not re.fullmatch(r"[-+]?\d[\d.]*", following):
            yield "1"


def replay(
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN or EPISODE]",
            help="A run or policy to roll out, or a recorded episode (.npz).",
            show_default="latest",
            autocompletion=completion.complete_run,
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            "--episodes", help="Episodes to roll out, or to choose from.", min=1, show_default="1; 100 to choose from"
        ),
    ] = None,
    worst: Annotated[int | None, typer.Option(metavar="[N]", help="The N (1) worst of --episodes.", min=1)] = None,
    best: Annotated[int | None, typer.Option(metavar="[N]", help="The N (1) best of --episodes.", min=1)] = None,
    failures: Annotated[
        int | None, typer.Option(metavar="[N]", help="Up to N (1) that failed of --episodes, worst first.", min=1)
    ] = None,
    seed: EpisodeSeed = 0,
    checkpoint: Checkpoint = "best",
    pretrained: Pretrained = False,
    task: Annotated[
        str | None, typer.Option(help="Roll out on this task instead of the one it was trained on.")
    ] = None,
    settings: Set = [],
    verify: Annotated[
        Path | None, typer.Option(metavar="EPISODE", help="Replay a recorded episode; exit 1 unless identical.")
    ] = None,
    gui: Annotated[bool, typer.Option("--gui", help="Show it in PyBullet's window instead of recording.")] = False,
    sim: Annotated[
        str | None, typer.Option(metavar="mujoco[:SOLREF]", help="Play in MuJoCo instead of PyBullet.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PATH", help="An .rrd file or a folder. Default: episodes/ of the run."),
    ] = None,
    video: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a film instead, .mp4 or .gif.")] = None,
    json: Json = None,
) -> None:
    """Show what a policy does: rollouts as Rerun recordings, without a display."""
    claim_stdout()
    from rlctl.replaying.replay import ReplayRequest, run_replay
    from rlctl.replaying.report import show

    result = run_replay(
        ReplayRequest(
            source=source,
            episodes=episodes,
            seed=seed,
            checkpoint=choose_checkpoint(checkpoint, pretrained),
            task=task,
            changes=parse_changes(settings),
            verify=verify,
            gui=gui,
            output=output,
            video=video,
            sim=sim,
            choice=_read_choice(worst=worst, best=best, failures=failures),
        )
    )
    show(result, json)
    result.check()


def _read_choice(**counts: int | None) -> Choice | None:
    from rlctl.errors import UsageError
    from rlctl.replaying.replay import Choice

    given = [Choice(kind, count) for kind, count in counts.items() if count is not None]  # type: ignore[arg-type]
    if len(given) > 1:
        raise UsageError(f"--{given[0].kind} and --{given[1].kind}: give one of --worst, --best and --failures")
    return given[0] if given else None
