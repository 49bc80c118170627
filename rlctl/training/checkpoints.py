"""What a training writes into its run folder, and what a resume takes back; a disk that fails stops nothing."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rlctl.errors import ArtifactError
from rlctl.policy.file import PolicyFile
from rlctl.run.directory import RunDirectory
from rlctl.storage import files
from rlctl.storage.table import Table
from rlctl.training.checkpoint import Checkpoints
from rlctl.training.evaluation_episodes import remove_after
from rlctl.training.progress import Progress

CHECKPOINT_TIME_SHARE = 0.02
"""Part of the training's time that checkpoints may take."""


class Saver:
    """Writes tables, policies and checkpoints. What cannot be written costs a warning and is tried again."""

    def __init__(self, run: RunDirectory, checkpoints: Checkpoints, warn: Callable[[str], None]) -> None:
        self.run = run
        self.metrics = Table(run.metrics_file)
        self.evals = Table(run.evals_file)
        self.saved_step: int | None = None
        """Step of the last checkpoint that is whole on the disk."""
        self.problem = ""
        """What could not be written the last time, and why."""
        self._checkpoints = checkpoints
        self._warn = warn
        self._next_checkpoint = time.monotonic()
        self._uncounted_checkpoints = 1
        """Checkpoints that come whether they are due or not: the last one."""
        self._reported: set[str] = set()
        """Problems that were reported since everything was saved."""
        self._unsaved_best: PolicyFile | None = None
        """The best policy, until the disk takes it."""

    def attempt(self, what: str, write: Callable[[], object]) -> bool:
        """Write something; False, with a warning, if the disk does not take it.

        Raises `ArtifactError` if somebody has removed the run, `RunTaken` if another process writes it now.
        """
        if not self.run.status_file.exists():
            raise ArtifactError(f"{self.run.path}: was removed while it trained, so nothing can be saved; train anew")
        self.run.check_claim()
        try:
            write()
        except OSError as error:
            self._report(f"{what}: {error.strerror or error}")
            return False
        return True

    def _report(self, problem: str) -> None:
        if problem not in self._reported:
            self._warn(f"warning: not saved: {problem}; training goes on")
        self._reported.add(problem)
        self.problem = problem

    def row(self, table: Table, row: dict[str, Any]) -> None:
        """Add a row to a table; one that the disk does not take now is written with the next."""
        table.add(row)
        self.attempt(table.path.name, table.flush)

    def save_best(self, policy: PolicyFile) -> None:
        """Write the best policy; one that the disk does not take now is written before the next checkpoint."""
        self._unsaved_best = policy
        self.attempt("best policy", self._write_best)

    def read_best(self) -> PolicyFile:
        """Return the best policy. Raises `ArtifactError` if its file is gone or damaged."""
        return self._unsaved_best or PolicyFile.read(self.run.best_policy)

    def _write_best(self) -> None:
        if self._unsaved_best is not None:
            self._unsaved_best.write(self.run.best_policy)
        self._unsaved_best = None

    def checkpoint_is_due(self) -> bool:
        """Whether the time that checkpoints may take allows one."""
        return time.monotonic() >= self._next_checkpoint

    def checkpoint(self, pack: Callable[[], PolicyFile], progress: Progress) -> bool:
        """Write the last policy and a checkpoint; False, with a warning, if the disk does not take it."""
        began = time.monotonic()
        policy = pack()
        saved = self.attempt("checkpoint", lambda: self._write_checkpoint(policy, progress))
        if saved:
            self._report_saved_again()
            self.attempt("old checkpoints", self._checkpoints.remove_old)
        now = time.monotonic()
        self._next_checkpoint = now + (1 + self._uncounted_checkpoints) * (now - began) / CHECKPOINT_TIME_SHARE
        self._uncounted_checkpoints = 0
        return saved

    def _report_saved_again(self) -> None:
        if self._reported:
            self._warn(f"saved again, at step {self.saved_step:,}")
        self._reported.clear()

    def _write_checkpoint(self, policy: PolicyFile, progress: Progress) -> None:
        # Whoever goes on from a checkpoint will not come by here again: everything before it must be on the disk.
        self.metrics.flush(sync=True)
        self.evals.flush(sync=True)
        progress.metrics_bytes, progress.evals_bytes = self.metrics.size, self.evals.size
        progress.metrics_sha256, progress.evals_sha256 = self.metrics.digest(), self.evals.digest()
        self._write_best()
        policy.write(self.run.last_policy)
        self._checkpoints.save(policy, progress)
        self.saved_step = policy.info.training_steps


def cut_back(run: RunDirectory, step: int, progress: Progress) -> list[str]:
    """Put a run folder back to where the checkpoint of a step has it; return warnings.

    Tables are cut back, checkpoints that are damaged are set aside, and the best policy stays the best there is.
    """
    for folder in run.checkpoints():
        if int(folder.name) > step:
            files.set_aside(folder)
    remove_after(run, step)
    warnings = []
    for file, size, sha256 in (
        (run.metrics_file, progress.metrics_bytes, progress.metrics_sha256),
        (run.evals_file, progress.evals_bytes, progress.evals_sha256),
    ):
        if not Table(file).cut_back(size, sha256, step):
            warnings.append(
                f"warning: {file}: edited or damaged: its rows up to step {step:,} are not those that were written; "
                "they are kept as they are, without lines that are not whole"
            )
    return warnings + _read_best_score(run, progress)


def _read_best_score(run: RunDirectory, progress: Progress) -> list[str]:
    """Take the score from the best policy's own file, which may be newer than the checkpoint.

    Return a warning if it is not as good as the checkpoint says.
    """
    best_step, problem = progress.best_step, ""
    score = (progress.best_success or 0.0, progress.best_return or 0.0)
    progress.best_success = progress.best_return = progress.best_step = None
    try:
        info = PolicyFile.read(run.best_policy).info
    except ArtifactError as error:
        problem = str(error)
    else:
        if info.evaluation is not None:
            progress.best_success, progress.best_return = info.evaluation.success, info.evaluation.mean_return
            progress.best_step = info.training_steps
        if progress.best_step is None or (progress.best_success or 0.0, progress.best_return or 0.0) < score:
            problem = f"{run.best_policy}: not the best policy, but that of step {info.training_steps:,}"
    if best_step is None or not problem:
        return []
    return [f"warning: {problem}; the best one was that of step {best_step:,}, and is lost unless a checkpoint has it"]
