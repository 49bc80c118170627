"""The teacher of a distillation: a policy file, of which the run keeps a copy for a resume."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl.errors import ArtifactError
from rlctl.play import messages
from rlctl.policy.file import PolicyInfo
from rlctl.policy.load import load_policy
from rlctl.runs.directory import RunDirectory
from rlctl.storage import files


@dataclasses.dataclass(frozen=True)
class Teacher:
    """A policy, and the number of steps, of all environments together, for which the student learns from it."""

    file: Path
    info: PolicyInfo
    steps: int

    @classmethod
    def read(cls, file: Path, steps: int) -> "Teacher":
        """Read a policy file (.safetensors or .onnx); raises `ArtifactError` if it is not one."""
        return cls(file, load_policy(file).info, steps)

    @classmethod
    def of_run(cls, run: RunDirectory, entry: Mapping[str, Any]) -> "Teacher":
        """Read the copy in a run by the entry of `run.json`; raises `ArtifactError` if it has changed."""
        file = run.teacher_file(Path(entry["policy"]).suffix)
        if not file.exists():
            raise ArtifactError(f"{file}: no such file; without its teacher this run cannot be resumed")
        files.check_digest(file, entry["sha256"])
        return cls.read(file, int(entry["steps"]))

    def describe(self) -> dict[str, Any]:
        """Return the entry `teacher` of `run.json`."""
        return {
            "policy": str(self.file.absolute()),
            "sha256": files.digest(self.file.read_bytes()),
            "algo": self.info.algo,
            "training_steps": self.info.training_steps,
            "steps": self.steps,
        }

    def copy_to(self, run: RunDirectory) -> None:
        """Write the copy that a resume reads."""
        files.write_bytes(run.teacher_file(self.file.suffix), self.file.read_bytes())

    def to_message(self) -> messages.LabellingPolicy:
        """Return the teacher for workers."""
        return messages.LabellingPolicy(str(self.file.absolute()), self.info.spec)
