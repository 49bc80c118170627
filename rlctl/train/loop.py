"""What happens at the boundaries between updates: metrics, evaluation, checkpoints, stopping.

SB3 calls `on_rollout_start` after each update and before the next step. All of rlctl's own work is done there, so
that a checkpoint never falls inside a rollout. What is decided there is decided by steps, never by the clock, but for
when to write a checkpoint, which changes nothing: so a run that was resumed is the run that was never stopped.
"""

from __future__ import annotations

import dataclasses
import time

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from rlctl.errors import ArtifactError, Interrupted, RlctlError, TaskError, UsageError
from rlctl.eval.statistics import mean_return, success_rate
from rlctl.rollout.collect import Episode
from rlctl.run.directory import RunDirectory
from rlctl.run.policy import Score
from rlctl.run.recipe import ON_POLICY, Recipe
from rlctl.train import faults, measurements, snapshot, table_rows
from rlctl.train.checkpoint import Checkpoint
from rlctl.train.curriculum import Curriculum, begin_next_episodes
from rlctl.train.display import Display
from rlctl.train.episodes import EpisodeKeeper
from rlctl.train.evaluation import Evaluator
from rlctl.train.findings import FindingReporter
from rlctl.train.finite import check_finite
from rlctl.train.pack import pack
from rlctl.train.progress import Progress
from rlctl.train.saving import Packed, Saver
from rlctl.train.vec_env import WorkerVecEnv

_OFF_POLICY_ROWS = 200  # rows of metrics a training has, about: off-policy updates come at every step


@dataclasses.dataclass(frozen=True)
class Learner:
    """What learns, where it learns, and how far it has come."""

    model: BaseAlgorithm
    env: WorkerVecEnv
    curriculum: Curriculum
    progress: Progress


class TrainingStopped(Exception):
    """Ends SB3's `learn` at a boundary; nothing is wrong."""


class _StopRequested(Exception):
    """A signal came while evaluation episodes were played."""


class TrainingLoop(BaseCallback):
    """Runs at every boundary; raises `TrainingStopped` when the recipe's success rate holds."""

    def __init__(
        self,
        run: RunDirectory,
        recipe: Recipe,
        learner: Learner,
        evaluator: Evaluator,
        saver: Saver,
        display: Display,
        resumed: Checkpoint | None = None,
    ) -> None:
        super().__init__()
        self.run_directory = run
        self.recipe = recipe
        self.model = learner.model
        self.env = learner.env
        self.curriculum = learner.curriculum
        self.progress = learner.progress
        self.saver = saver
        self.display = display
        self.stop_signal: int | None = None
        self.episodes = EpisodeKeeper(run, learner.curriculum.goal_spec, learner.curriculum.goal)
        self._evaluator = evaluator
        self._findings = FindingReporter(run, display.message)
        self._resumed = resumed
        self._stop_announced = False
        self._started = time.monotonic() - self.progress.seconds
        self._last_row = (time.monotonic(), self.model.num_timesteps)

    def _on_step(self) -> bool:
        self.display.steps(self.model.num_timesteps)
        self.announce_stop()
        return True

    def announce_stop(self) -> None:
        """Show, once, that a signal has been taken."""
        if self.stop_signal is not None and not self._stop_announced:
            self._stop_announced = True
            self.display.message(
                "stopping after this update, with a checkpoint; press Ctrl-C again to stop immediately"
            )

    def _on_rollout_start(self) -> None:
        resumed, self._resumed = self._resumed, None
        if resumed is not None and not resumed.state.at_end:
            # gSDE has just drawn, as it had when the checkpoint was taken.
            snapshot.restore_randomness(self.model, resumed.tensors, resumed.state.model)
        if self.model.num_timesteps > 0:
            self.boundary()
        elif self.saver.saved_step is None:
            # The first update may be minutes away: better to know now what cannot be saved.
            self._take_ended()
            if self.progress.next_eval == 0:
                self.evaluate()
            self.save_checkpoint()

    def boundary(self) -> None:
        """Do everything that is due after an update, except what the resumed checkpoint has done already."""
        steps = self.model.num_timesteps
        self._take_ended()
        stage_done = self.curriculum.is_due(steps)
        self._write_metrics_if_due(steps, stage_done)
        if stage_done:
            self._begin_next_stage(steps)
        self._stop_if_requested()
        if steps >= self.progress.next_eval:
            self.evaluate()
            if self._is_good_enough():
                self._save_the_end(at_end=False)
                raise TrainingStopped
            self._stop_if_requested()
        if self.saver.checkpoint_is_due():
            self.save_checkpoint()

    def _take_ended(self) -> None:
        ended = self.env.take_ended()
        self.progress.recent += ended
        self.curriculum.count(ended)
        if warning := self.curriculum.warning():
            self.display.message(warning)
        if warning := self.env.monitor.report(self.progress):
            self.display.message(warning)

    def _begin_next_stage(self, steps: int) -> None:
        self.env.workers.rebuild(self.curriculum.next_spec())
        begin_next_episodes(self.model)
        self.display.stage(*self.curriculum.enter_next_stage(steps))

    def _is_good_enough(self) -> bool:
        return self.recipe.stop_success is not None and self.progress.good_in_a_row >= 2

    def _stop_if_requested(self) -> None:
        if self.stop_signal is not None:
            self._stop(self.stop_signal, at_end=False)

    def _stop(self, number: int, *, at_end: bool) -> None:
        saved = self.save_checkpoint(at_end=at_end)
        state = "checkpoint saved" if saved else "the last saved checkpoint stands"
        raise Interrupted(
            f"interrupted at step {self.model.num_timesteps:,}; {state}. Go on with: "
            f"rlctl train --resume {self.run_directory.path}",
            number,
        )

    def finish(self) -> None:
        """Evaluate and save what the training ended with; raises `ArtifactError` if it cannot be saved."""
        steps = self.model.num_timesteps
        self._take_ended()
        stage_done = self.curriculum.is_due(steps)
        self._write_metrics_if_due(steps, True)
        if stage_done:  # for a resume that makes the run longer
            self._begin_next_stage(steps)
        if self.progress.last_eval < steps:
            self.evaluate(at_end=True)
        self.logger.dump(steps)
        self._save_the_end(at_end=True)

    def _save_the_end(self, *, at_end: bool) -> None:
        self.progress.done = True
        if not self.saver.retry(lambda: self.save_checkpoint(at_end=at_end)):
            raise ArtifactError(
                f"{self.run_directory.path}: the training is done, but could not be saved: {self.saver.problem}"
            )

    def _write_metrics_if_due(self, steps: int, anyway: bool) -> None:
        due = anyway or self.recipe.algo in ON_POLICY or steps >= self.progress.next_row
        if due and steps > self.progress.last_row:
            check_finite(self.model, self.run_directory.path)
            self._write_metrics(steps)
            self.progress.last_row = steps
            self.progress.next_row = steps + max(1, self.recipe.total_timesteps // _OFF_POLICY_ROWS)

    def _write_metrics(self, steps: int) -> None:
        now = time.monotonic()
        before, steps_before = self._last_row
        self._last_row = (now, steps)
        recent, self.progress.recent = self.progress.recent, []
        terms = list(self.env.workers.info.reward_weights)
        elapsed = max(now - before, 1e-9)
        row = {
            "steps": steps,
            "seconds": round(now - self._started, 3),
            "fps": round((steps - steps_before) / elapsed, 1),
            "playing": round(self.env.waited_s / elapsed, 3),
            **self.curriculum.columns(),
            **table_rows.training_row(recent, terms, self.logger.name_to_value),
            **measurements.measure(self.model, self.env, self.progress.last_row, self.recipe.total_timesteps),
        }
        self.env.waited_s = 0.0
        self.saver.row(self.saver.metrics, row)
        for name, number in self.curriculum.columns().items():
            self.logger.record(f"curriculum/{name}", number)
        for column, name in (
            ("distance", "rollout/final_distance"),
            *((f"term/{t}", f"reward_terms/{t}") for t in terms),
        ):
            if (value := row[column]) is not None:
                self.logger.record(name, value)
        self.display.metrics(row)

    def evaluate(self, *, at_end: bool = False) -> None:
        """Play the evaluation episodes, save the best policy, and write the row and the episodes.

        An environment that fails costs this evaluation, not the training.
        """
        steps, began = self.model.num_timesteps, time.monotonic()
        packed = self._pack()
        self.display.phase("evaluating")
        try:
            self._record_evaluation(self._evaluator.run(*packed, self._raise_if_stop_requested), packed)
        except _StopRequested:
            assert self.stop_signal is not None
            self._stop(self.stop_signal, at_end=at_end)
        except (TaskError, UsageError, ArtifactError) as error:  # the last two where files were removed meanwhile
            self._evaluation_failed(error)
        self.progress.last_eval = steps
        if not at_end:
            self._findings.report_new()
        while self.progress.next_eval <= steps:
            self.progress.next_eval += self.recipe.eval.every_steps or self.recipe.total_timesteps
        # The rate of training is without the time of evaluations.
        self._last_row = (self._last_row[0] + time.monotonic() - began, self._last_row[1])

    def _raise_if_stop_requested(self) -> None:
        # An evaluation may take minutes, too long to wait after a signal; the resumed run repeats it.
        if self.stop_signal is not None:
            raise _StopRequested

    def _evaluation_failed(self, error: RlctlError) -> None:
        progress, steps = self.progress, self.model.num_timesteps
        progress.failed_evaluations += 1
        progress.first_failure = progress.first_failure or f"at step {steps:,}: {error}"
        error = faults.keep_episode(error, self.curriculum.goal_spec, self.saver, self.episodes, steps)
        self.display.message(f"warning: evaluation at step {steps:,} failed, training goes on: {error}")

    def _record_evaluation(self, episodes: list[Episode], packed: Packed) -> None:
        progress, steps = self.progress, self.model.num_timesteps
        results = [episode.result for episode in episodes]
        success, mean = success_rate(results), mean_return(results)
        better = self._is_better(success, mean)
        if better:
            info = packed[0].model_copy(update={"evaluation": Score(success=success, mean_return=mean)})
            self.saver.save_best((info, packed[1]))
            progress.best_success, progress.best_return, progress.best_step = success, mean, steps
        threshold = self.recipe.stop_success
        good = threshold is not None and success is not None and success >= threshold
        progress.good_in_a_row = progress.good_in_a_row + 1 if good else 0
        row = {
            "steps": steps,
            "seconds": round(time.monotonic() - self._started, 3),
            **self.curriculum.columns(),
            **table_rows.evaluation_row(results),
        }
        self.saver.row(self.saver.evals, row)
        self.logger.record("eval/mean_reward", mean)
        if success is not None:
            self.logger.record("eval/success_rate", success)
        self.saver.attempt("episodes", lambda: self.episodes.keep(episodes, steps))
        self.display.evaluation(steps, success, mean, better)

    def _pack(self) -> Packed:
        goal = self.curriculum
        return pack(self.model, self.recipe.algo, goal.goal_spec, goal.goal, goal.specs())

    def _is_better(self, success: float | None, mean: float) -> bool:
        best = self.progress
        if best.best_step is None:
            return True
        if success is not None and best.best_success is not None and success != best.best_success:
            return success > best.best_success
        return best.best_return is None or mean > best.best_return

    def explain_fault(self, error: TaskError) -> TaskError:
        """Keep the actions of the episode that failed, and return the error with what to do next."""
        return faults.explain_fault(error, self.run_directory, self.env, self.saver, self.episodes)

    def save_checkpoint(self, *, at_end: bool = False) -> bool:
        """Write a checkpoint of the present boundary; False, with a warning, if the disk does not take it."""
        check_finite(self.model, self.run_directory.path)
        self.progress.seconds = time.monotonic() - self._started
        return self.saver.checkpoint(self._pack, self.progress, at_end=at_end)
