"""The policies that are compared: of runs, or files in their place."""

from pathlib import Path
from typing import Any

from rlctl.policy.load import load_policy
from rlctl.runs.directory import RunDirectory
from rlctl.storage import files


class PolicyAlone(RunDirectory):
    """A policy file, such as the one that is in use, in the place of the run it comes from."""

    def __init__(self, path: Path) -> None:
        """Read it; raises `ArtifactError` if it is not a policy."""
        super().__init__(path)
        self._task = load_policy(path).info.spec.task

    def status(self) -> dict[str, Any]:
        """Return what is known of its training."""
        return {"task": self._task, "status": "finished"}

    def policy_file(self, which: str = "best") -> Path:
        """Return the file itself."""
        return self.path


def find_same_policy(run: RunDirectory, baseline: RunDirectory) -> str:
    """Return the sha256 of a run's best policy if it is that of the baseline; else an empty text."""
    one, two = (files.digest(each.policy_file().read_bytes()) for each in (run, baseline))
    return one if one == two else ""


def reports_success(run: RunDirectory) -> bool:
    """Return whether the task of a run's best policy reported success in the training; False where it is not known."""
    score = load_policy(run.policy_file()).info.evaluation
    return score is not None and score.success is not None
