"""`rlctl replay`."""

import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator
from typing import Any

from typer.core import TyperCommand

from rlctl.cli.arguments import choose_checkpoint, command
from rlctl.options import Json, Pretrained
from rlctl.replaying.request import ReplayRequest

_BY_OUTCOME = ("--worst", "--best", "--failures")


class ReplayCommand(TyperCommand):
    """Reads `--best RUN` as `--best 1 RUN`; the same for `--worst` and `--failures`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the missing counts, then parse as Typer does."""
        return super().parse_args(ctx, list(_fill_counts(args)))


def _fill_counts(arguments: Iterable[str]) -> Iterator[str]:
    for argument, following in itertools.pairwise([*arguments, ""]):
        yield argument
        # Only a number belongs to the option; any other word may be the run.
        if argument in _BY_OUTCOME and not re.fullmatch(r"[-+]?\d[\d.]*", following):
            yield "1"


@command
def replay(request: ReplayRequest, pretrained: Pretrained = False, json: Json = None) -> None:
    """Show what a policy does: rollouts as Rerun recordings, without a display."""
    from rlctl.replaying.replay import run_replay
    from rlctl.replaying.report import show

    checkpoint = choose_checkpoint(request.checkpoint, pretrained)
    result = run_replay(dataclasses.replace(request, checkpoint=checkpoint))
    show(result, json)
    result.check()
