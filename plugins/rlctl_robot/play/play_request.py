"""The options of `rlctl play` as data. Imports nothing heavy."""

import dataclasses
from pathlib import Path
from typing import Annotated

from rlctl.options import Checkpoint, EpisodeSeed, Option, RunName, Settings, SimOption


@dataclasses.dataclass(frozen=True)
class PlayRequest:
    """The policy that is steered, where, and what is recorded."""

    run: RunName = None
    task: Annotated[str | None, Option("Play on this task instead of the one it was trained on.")] = None
    checkpoint: Checkpoint = "best"
    settings: Settings = dataclasses.field(default_factory=list)
    sim: SimOption = None
    seed: EpisodeSeed = 0
    record: Annotated[bool, Option("Record from the start; the page has a button for it, too.", ("--record",))] = False
    output: Annotated[
        Path | None,
        Option("A folder for recordings. Default: episodes/ of the run.", ("--output", "-o"), metavar="FOLDER"),
    ] = None
    port: Annotated[int, Option("Port of the page, on this machine only; 0: any free port.", min=0, max=65535)] = 8002
