"""The options of `rlctl diagnose` as data. Imports nothing heavy."""

import dataclasses
from pathlib import Path
from typing import Annotated

from rlctl.options import Checkpoint, Option, Pretrained


@dataclasses.dataclass(frozen=True)
class DiagnoseRequest:
    """Which policy a log is compared with, and how its columns are called."""

    policy: Annotated[
        str | None,
        Option(
            "Run folder, policy file, task name, or latest.",
            ("--policy",),
            metavar="RUN",
            completes="run",
            default_text="latest",
        ),
    ] = None
    checkpoint: Checkpoint = "best"
    pretrained: Pretrained = False
    columns: Annotated[
        Path | None,
        Option("Columns of each observation and of the actions (YAML); default: by their names.", metavar="FILE"),
    ] = None
    limits: Annotated[Path | None, Option("Limits with which the program has run (limits.yaml).", metavar="FILE")] = (
        None
    )
    output: Annotated[
        Path | None,
        Option("Write the corrected mapping, for export --controller --mapping.", ("--output", "-o"), metavar="FILE"),
    ] = None
    seed: Annotated[int, Option("Seed of the rollouts in simulation.", min=0)] = 0
