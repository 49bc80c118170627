"""The arguments of `rlctl tune` as data. Imports nothing heavy."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from rlctl.options import Config, Option, OptionalTask, RunsFolder

Metric = Literal["return", "success"]


@dataclasses.dataclass(frozen=True)
class TuneRequest:
    """The arguments of `rlctl tune`; either `task` or `resume` is given."""

    task: OptionalTask = None
    resume: Annotated[
        str | None, Option("Resume a tuning: its folder, a task's name, or latest.", metavar="FOLDER")
    ] = None
    search: Annotated[
        list[str],
        Option(
            "Search this key, or KEY=A,B,C; repeat to search several keys together.",
            metavar="KEY=LOW:HIGH",
            default_text="learning rate; then n_steps and batch_size; then gamma",
        ),
    ] = dataclasses.field(default_factory=list)
    trials: Annotated[
        int, Option("Trainings per step of the search, at most; the first has the unchanged recipe.", min=2, max=1000)
    ] = 8
    metric: Annotated[Metric, Option("What to maximise.", metavar="return|success")] = "return"
    storage: Annotated[
        str | None,
        Option(
            "Optuna's storage, e.g. sqlite:///tune.db; equal searches with this storage share their trials.",
            metavar="URL",
        ),
    ] = None
    config: Config = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Keys of the recipe and their values, for every trial; they override `config`."""
    root: RunsFolder = Path("runs")
