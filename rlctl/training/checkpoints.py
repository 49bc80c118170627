"""What a training writes into its run folder, and what a resume restores; a failing disk stops no training."""

import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rlctl.errors import ArtifactError
from rlctl.play.episode import load_episode
from rlctl.policy.file import PolicyFile
from rlctl.policy.own_modules import describe_change
from rlctl.policy.torch_policy import describe_network
from rlctl.runs.directory import RunDirectory
from rlctl.storage import files
from rlctl.storage.table import Table
from rlctl.training import checkpoint_file, snapshot
from rlctl.training.callbacks import Callbacks
from rlctl.training.checkpoint_file import Checkpoint, ReplayParts
from rlctl.training.learner import Learner, begin_next_episodes
from rlctl.training.snapshot import check_finite

CHECKPOINT_TIME_SHARE = 0.02  # share of the training time that checkpoints may take


class Checkpoints:
    """Writes tables, policies and checkpoints. A write that fails causes a warning and is repeated later."""

    def __init__(self, learner: Learner, run: RunDirectory, callbacks: Callbacks, warn: Callable[[str], None]) -> None:
        """Write into the folder of `run`; `warn` shows a message."""
        self.run = run
        self.callbacks = callbacks
        self.metrics = Table(run.metrics_file)
        self.evals = Table(run.evals_file)
        self.saved_step: int | None = None  # step of the last complete checkpoint
        self.problem = ""  # the last write that failed, and why
        self._learner = learner
        buffer = getattr(learner.model, "replay_buffer", None)
        self._replay = None if buffer is None else ReplayParts(run.replay_parts, buffer)
        self._warn = warn
        self._next_s = time.monotonic()
        self._uncounted_checkpoints = 1  # checkpoints that are written even if not due: the last one
        self._reported: set[str] = set()  # problems reported since the last successful checkpoint
        self._unsaved_best: PolicyFile | None = None  # the best policy, if it could not be written yet

    def attempt(self, what: str, write: Callable[[], object]) -> bool:
        """Call `write`; on an `OSError` warn about `what` and return False. Raises if the run was removed or taken."""
        if not self.run.status_file.exists():
            raise ArtifactError(
                f"{self.run.path}: was removed during training, so nothing can be saved; start a new training"
            )
        self.run.check_claim()
        try:
            write()
        except OSError as error:
            self.problem = f"{what}: {error.strerror or error}"
            if self.problem not in self._reported:
                self._warn(f"warning: not saved: {self.problem}; training continues")
            self._reported.add(self.problem)
            return False
        return True

    def row(self, table: Table, row: dict[str, Any]) -> None:
        """Add a row to a table; a row that cannot be written now is written with the next one."""
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

    def is_due(self) -> bool:
        """Return whether a checkpoint is due within `CHECKPOINT_TIME_SHARE`."""
        return time.monotonic() >= self._next_s

    def save(self) -> bool:
        """Write the last policy and a checkpoint; False, with a warning, if that failed. Raises `DivergedError`."""
        check_finite(self._learner.model, self.run.path)
        self._learner.progress.seconds = self._learner.seconds
        began = time.monotonic()
        is_saved = self.attempt("checkpoint", functools.partial(self._write, self._learner.pack()))
        if is_saved:
            if self._reported:
                self._warn(f"saved again, at step {self.saved_step:,}")
            self._reported.clear()
            self.attempt("old checkpoints", self._remove_old)
            self.callbacks.call("on_checkpoint")
        now = time.monotonic()
        self._next_s = now + (1 + self._uncounted_checkpoints) * (now - began) / CHECKPOINT_TIME_SHARE
        self._uncounted_checkpoints = 0
        return is_saved

    def _write(self, policy: PolicyFile) -> None:
        # A resume does not repeat earlier writes, so they must be on the disk before the checkpoint.
        progress = self._learner.progress
        self.metrics.flush(sync=True)
        self.evals.flush(sync=True)
        progress.metrics_bytes, progress.evals_bytes = self.metrics.size, self.evals.size
        progress.metrics_sha256, progress.evals_sha256 = self.metrics.digest(), self.evals.digest()
        self._write_best()
        policy.write(self.run.last_policy)
        self._write_checkpoint(policy)
        self.saved_step = policy.info.training_steps

    def _write_checkpoint(self, policy: PolicyFile) -> None:
        learner = self._learner
        tensors, plain = snapshot.take(learner.model)
        of_callbacks, plain_of_callbacks = self.callbacks.take()
        of_rollouts, plain["rollouts"] = learner.rollouts.take()
        tensors |= of_callbacks | of_rollouts | checkpoint_file.environment_tensors(learner.env)
        parts = []
        if self._replay is not None:
            parts = self._replay.save(self._added)
            tensors |= checkpoint_file.hindsight_tensors(self._replay.buffer)
        state = checkpoint_file.State(
            run=self.run.id(),
            step=learner.steps,
            model=plain,
            progress=learner.progress,
            callbacks=plain_of_callbacks,
            segments=parts,
            computed_with=checkpoint_file.describe_computation(learner.model.device),
        )
        checkpoint_file.write(self.run.checkpoint(state.step), state, policy, tensors)

    @property
    def _added(self) -> int:
        """Number of transitions added to the replay buffer; a step of all environments is one."""
        return self._learner.steps // self._learner.env.num_envs

    def _remove_old(self) -> None:
        """Remove all checkpoints except the newest `keep`, and parts of the replay buffer that none of these needs."""
        for old in self.run.checkpoints()[: -self._learner.recipe.checkpoint.keep]:
            files.remove_tree(old)
        if self._replay is not None:
            self._replay.remove_others(checkpoint_file.list_replay_parts(self.run))

    def restore(self, saved: Checkpoint, changed: Sequence[str]) -> str:
        """Restore a checkpoint; return a message with the reasons, `changed` and others, why it is not exact.

        Callbacks start before: what their `on_start` changes in the model and in the progress is overwritten.
        """
        self.callbacks.start(resumed_at=saved.state.step)
        learner, file = self._learner, saved.folder / "policy.safetensors"
        info = PolicyFile.read_info(file)
        info.check_fits(learner.curriculum.goal, file)
        if change := describe_change(info.policy_kwargs, describe_network(learner.model.policy)):
            raise ArtifactError(f"{file}: {change}; restore it, or start a new training with --from {file}")
        try:
            snapshot.restore(learner.model, saved.tensors, saved.state.model)
            learner.rollouts.restore(saved.tensors, saved.state.model.get("rollouts"))
            if self._replay is not None:
                self._replay.load(saved.state.segments, self._added)
                checkpoint_file.restore_hindsight(self._replay.buffer, saved.tensors)
            mismatch = checkpoint_file.restore_environments(learner.env, saved.tensors)
        except (ArtifactError, KeyError) as error:
            raise ArtifactError(f"{saved.folder}: {error}") from None
        # SB3 resets the environments if this is None; it has no other use here.
        learner.model._last_obs = learner.env.observations()
        now = checkpoint_file.describe_computation(learner.model.device)
        inexact = [*changed, *checkpoint_file.find_differences(saved.state.computed_with, now)]
        if mismatch is not None:
            inexact.append(mismatch)
            begin_next_episodes(learner.model)
            if self._replay is not None:
                self._replay.mark_last_changed(self._added)
        inexact += self.callbacks.restore(saved.tensors, saved.state.callbacks)
        self.saved_step = saved.state.step
        exactness = f"not bit-exact: {'; '.join(inexact)}" if inexact else "bit-exact"
        return f"resuming at step {self.saved_step:,}, {exactness}"

    def cut_back(self, step: int) -> list[str]:
        """Return the run folder to its state at a step; return warnings. Later checkpoints are set aside."""
        for folder in self.run.checkpoints():
            if int(folder.name) > step:
                files.set_aside(folder)
        for file in self.run.episodes.glob("*.npz"):
            if _is_later(file, step):
                files.remove(file)
        progress = self._learner.progress
        tables = (
            (self.metrics, progress.metrics_bytes, progress.metrics_sha256),
            (self.evals, progress.evals_bytes, progress.evals_sha256),
        )
        return [
            f"warning: {table.path}: edited or damaged: its rows up to step {step:,} differ from those that rlctl "
            "wrote; they are kept, except incomplete lines"
            for table, size, sha256 in tables
            if not table.cut_back(size, sha256, step)
        ]


def _is_later(file: Path, step: int) -> bool:
    """Return whether a file is an episode of an evaluation after a training step: a resumed run repeats it."""
    try:
        return (load_episode(file).info.evaluated_at or 0) > step
    except ArtifactError:
        return False  # damaged
