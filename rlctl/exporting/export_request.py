"""The request of an export."""

import dataclasses
from pathlib import Path
from typing import Literal

from rlctl.engine import Engine
from rlctl.errors import UsageError

Format = Literal["onnx", "c"]
DatasetFormat = Literal["minari", "lerobot"]


@dataclasses.dataclass(frozen=True)
class ExportRequest:
    """What to export and where to; raises `UsageError` for a file name with a wrong suffix."""

    run: str | None  # a run, a policy file, a task, or None for the latest run
    formats: tuple[Format, ...] = ("onnx",)
    checkpoint: str = "best"
    output: Path | None = None
    """Default: the run's `exports/`; the folder of a policy file without a run; this folder for a shipped policy."""
    policy: Path | None = None  # write the actor with its measured score to this file instead, as plugins ship it
    episodes: int = 100  # episodes of that measurement, or of a dataset
    dataset: DatasetFormat | None = None  # write a dataset of episodes instead; `output` is its folder

    controller: bool = False  # write the controller: from what a robot measures to joint targets within limits
    limits: Path | None = None  # of the controller
    sim: Engine = Engine()  # noqa: RUF009 (it cannot change)
    """Engine of the episodes that are compared; no choice: that of the training."""
    mapping: Path | None = None  # between a program's values and the controller's

    def __post_init__(self) -> None:
        if self.limits is not None and not self.controller:
            raise UsageError("--limits: only a controller has limits; add --controller")
        if self.mapping is not None and not self.controller:
            raise UsageError("--mapping: only a controller reads a robot's values; add --controller")
        if self.policy is not None and self.policy.suffix != ".safetensors":
            raise UsageError(f"--policy {self.policy}: the name of a policy file ends in .safetensors")
        if self.output is None or self.dataset is not None:
            return
        if self.output.suffix not in [f".{name}" for name in self.formats]:
            raise UsageError(f"--output {self.output}: give a name that ends in .{self.formats[0]}")
