"""The arguments of `rlctl distill` as data. Imports nothing heavy."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from rlctl.options import Checkpoint, EnvTimeout, Option, RunName, RunsFolder


@dataclasses.dataclass(frozen=True)
class DistillRequest:
    """The arguments of `rlctl distill`; the teacher is named as `rlctl eval` names a policy."""

    teacher: RunName = None
    observe: Annotated[
        str | None,
        Option(
            "What the student observes: names of the task's observations, with commas.",
            metavar="NAMES",
            default_text="what the teacher observes",
        ),
    ] = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Keys of the student's recipe and their values, nested as in a recipe."""
    checkpoint: Checkpoint = "best"
    then_ppo: Annotated[int, Option("Train on with rewards for so many steps.", metavar="STEPS", min=0)] = 0
    device: Annotated[str, Option("cpu, cuda, or auto: the faster one for this network.")] = "cpu"
    check: Annotated[bool, Option("Train without checking the environment first.", ("/--no-check",))] = True
    env_timeout_s: EnvTimeout = 60.0
    root: RunsFolder = Path("runs")
