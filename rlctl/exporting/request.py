"""The request of an export."""

import dataclasses
from pathlib import Path
from typing import Literal

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
    """Default: in the run's folder, next to a policy file without a run, or in this folder for a shipped policy."""
    policy: Path | None = None  # write the actor with its measured score to this file instead, as plugins ship it
    episodes: int = 100  # episodes of that measurement, or of a dataset
    dataset: DatasetFormat | None = None  # write a dataset of episodes instead; `output` is its folder

    def __post_init__(self) -> None:
        if self.policy is not None and self.policy.suffix != ".safetensors":
            raise UsageError(f"--policy {self.policy}: the name of a policy file ends in .safetensors")
        if (
            self.output is not None
            and self.dataset is None
            and self.output.suffix not in [f".{name}" for name in self.formats]
        ):
            kind = "an ONNX file" if self.formats[0] == "onnx" else "a C file"
            raise UsageError(f"--output {self.output}: the name of {kind} ends in .{self.formats[0]}")
