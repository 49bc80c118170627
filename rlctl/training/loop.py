"""A training: play, learn, and at the boundaries between updates write metrics, evaluate, save and stop.

Checkpoints are written between segments only. Steps decide what is done at a boundary, never the clock; so a resumed
run equals one that was never stopped. Only the time of checkpoints depends on the clock, and they change no result.
"""

import dataclasses
import functools
import shlex
import time
from collections.abc import Callable
from pathlib import Path

from rlctl.errors import ArtifactError, EpisodeFailed, Interrupted, TaskError
from rlctl.runs.best import describe_unevaluated_last
from rlctl.training import status
from rlctl.training.checkpoints import Checkpoints
from rlctl.training.display import Display
from rlctl.training.evaluator import Evaluator
from rlctl.training.learner import Learner
from rlctl.training.metrics import Metrics
from rlctl.training.snapshot import check_finite

_SEGMENT_MAY_TAKE_S = 3.0  # after a signal [s]: `timeout -k` and clusters kill some seconds later


class TrainingLoop:
    """The loop of a training whose environments, model and run folder are ready."""

    def __init__(self, learner: Learner, evaluator: Evaluator, checkpoints: Checkpoints, display: Display) -> None:
        self.learner = learner
        self.evaluator = evaluator
        self.checkpoints = checkpoints
        self.stop_signal: int | None = None  # number of the signal after which to stop at the next boundary
        self.has_begun = False  # whether the first episodes have begun; before, a signal has nothing to save
        self.callbacks = checkpoints.callbacks
        self._metrics = Metrics(learner, checkpoints, display)
        self._display = display
        self._stop_at_s: float | None = None  # when to stop even inside a segment, after a signal
        self._resume_command = shlex.join(["rlctl", "train", "--resume", str(checkpoints.run.path)])
        learner.start_clock()

    def run(self) -> None:
        """Play and learn until the training is done. Raises `Interrupted` after a signal, when the state is saved."""
        learner = self.learner
        if learner.recipe.stages:
            self._display.stage(learner.curriculum.title)
        self._display.phase("first steps")
        try:
            learner.rollouts.begin(learner.recipe.total_timesteps)
            self.has_begun = True
            while not self.boundary():
                learner.rollouts.advance(self._watch_segment)
                self._display.steps(learner.steps)
        except TaskError as error:
            raise self._explain_fault(error) from None
        except ValueError:
            # SB3's distributions raise it for NaN weights.
            check_finite(learner.model, self.checkpoints.run.path)
            raise

    def boundary(self) -> bool:
        """Do what is due between two updates; return whether the training is done.

        A resumed run calls this again at the step of its checkpoint, and then equals one that was never stopped because
        nothing is done twice. What was done is in `Progress`, which checkpoints store: `last_row` of metrics,
        `last_segment` of callbacks, `next_eval` and `last_eval` of evaluations, `stage_episodes`, which a new stage
        empties. Anything that is added here needs such a guard. What came after the checkpoint is repeated; only the
        file of the best policy may be newer, and is kept then (`Evaluator._is_better`).
        """
        learner = self.learner
        finished = self._metrics.collect_finished_episodes()
        if learner.steps == 0:
            self._begin()
            return False
        stage_is_done = learner.curriculum.is_due(learner.steps)
        row = self._metrics.measure() if learner.is_at_end or stage_is_done or self._metrics.is_due() else {}
        self.callbacks.finish_segment(row, finished)
        if row:
            self._metrics.write(row)
        if stage_is_done:  # also at the end: a resume may make the run longer
            self._display.stage(*learner.begin_next_stage())
        self._stop_if_requested()
        if self.evaluator.is_due():
            self.evaluate()
        if learner.is_at_end or learner.progress.good_in_a_row >= 2:
            if learner.progress.stop_reason:
                self._display.message(f"stopped by a callback: {learner.progress.stop_reason}")
            self.evaluator.compare_best_with_last(self._stop_if_requested)
            self._save_the_end()
            return True
        self._stop_if_requested()
        if self.checkpoints.is_due():
            self.checkpoints.save()
        return False

    def _begin(self) -> None:
        """Save the initial state now: a folder that cannot be written is reported before the first update."""
        if self.checkpoints.saved_step is None:
            self.callbacks.start()
            if self.learner.progress.next_eval == 0:
                self.evaluate()
            self.checkpoints.save()

    def evaluate(self) -> None:
        """Evaluate the current policy; the training rate excludes this time."""
        began = time.monotonic()
        if row := self.evaluator.evaluate(self._stop_if_requested):
            self.callbacks.finish_evaluation(row)
        self._metrics.exclude(time.monotonic() - began)

    def _watch_segment(self) -> None:
        """Show how far a segment is; after a signal give it some seconds to end, then stop without it."""
        learner = self.learner
        self._display.playing(learner.steps + learner.env.steps_in_segment)
        if self.stop_signal is None:
            return
        if self._stop_at_s is None:
            self._stop_at_s = time.monotonic() + _SEGMENT_MAY_TAKE_S
            self._display.message("stopping, with a checkpoint; Ctrl-C again stops immediately")
        elif time.monotonic() > self._stop_at_s:
            learner.env.workers.close(grace_s=0.0)
            # Nothing of the segment is stored: the state is that of the last boundary, except that with overlap the
            # model has learned since then.
            self._stop_if_requested(may_save=not learner.rollouts.overlap)

    def _stop_if_requested(self, *, may_save: bool = True) -> None:
        if self.stop_signal is None:
            return
        steps, saved_step = self.learner.steps, self.checkpoints.saved_step
        if may_save and (saved_step == steps or self.checkpoints.save()):
            state = "checkpoint saved"
        else:
            state = f"the last saved checkpoint{'' if saved_step is None else f', of step {saved_step:,},'} is intact"
        unevaluated = describe_unevaluated_last(self.checkpoints.run)
        if unevaluated:
            self._display.message(unevaluated)
        raise Interrupted(
            f"interrupted at step {steps:,}; {state}. Resume with: {self._resume_command}", self.stop_signal
        )

    def _save_the_end(self) -> None:
        self.learner.progress.done = True
        # Retry once: no later checkpoint will be written.
        if not self.checkpoints.save() and not self.checkpoints.save():
            problem = self.checkpoints.problem
            raise ArtifactError(f"{self.checkpoints.run.path}: the training is done, but could not be saved: {problem}")

    def _explain_fault(self, error: TaskError) -> TaskError:
        workers = self.learner.env.workers
        spec = workers.spec
        if isinstance(error, EpisodeFailed):
            spec = dataclasses.replace(spec, level=float(workers.arrays.level[error.env]))
        lines = [str(self.evaluator.episodes.keep_failed(error, spec))]
        if step := self.checkpoints.saved_step:  # at step 0 there is nothing to resume
            lines.append(f"checkpoint at step {step:,} is intact; resume with: {self._resume_command}")
        return TaskError("\n".join(lines), details=error.details)

    def write_end(self, recordings: int, record: Callable[[list[Path]], list[Path]]) -> list[Path]:
        """Write the status `finished`; return recordings of the last evaluation's last episodes.

        `record` makes them of the files of these episodes.
        """
        run, learner, best = self.checkpoints.run, self.learner, self.evaluator.best
        write = functools.partial(status.write_end, run, learner.steps, learner.progress, best)
        if not self.checkpoints.attempt("run.json", write):
            self.checkpoints.attempt("run.json", write)  # retry once
        written = record(self.evaluator.episodes.save_last(recordings))
        self.callbacks.call("on_end")
        return written
