"""A training: play, learn, and at the boundaries between updates write metrics, evaluate, save and stop.

A checkpoint never falls inside a segment. What is done at a boundary is decided by steps, never by the clock, but for
when to write a checkpoint, which changes nothing: so a run that was resumed is the run that was never stopped.
"""

from __future__ import annotations

import dataclasses
import shlex
import time
from pathlib import Path
from typing import Any

from rlctl.errors import ArtifactError, Interrupted, RlctlError, TaskError, UsageError
from rlctl.evaluation.episode_statistics import mean_return, success_rate
from rlctl.policy.file import PolicyFile, Score
from rlctl.recipe.recipe import ON_POLICY, Recipe
from rlctl.rollout.collect import Episode
from rlctl.runs.diagnosis import Grade, diagnose
from rlctl.runs.summary import read_table
from rlctl.training import measurements, status
from rlctl.training.checkpoints import Saver
from rlctl.training.curriculum import Curriculum, begin_next_episodes
from rlctl.training.display import Display, format_score
from rlctl.training.evaluation_episodes import Evaluator
from rlctl.training.progress import Progress
from rlctl.training.rollouts import Rollouts
from rlctl.training.snapshot import check_finite, pack

_FINAL_EPISODES = 30
"""At least so many new episodes decide between the best policy and the last."""
_OFF_POLICY_ROWS = 200  # rows of metrics a training has, about: off-policy updates come at every step


@dataclasses.dataclass(frozen=True)
class Learner:
    """What learns, where it learns, and how far it has come."""

    recipe: Recipe
    rollouts: Rollouts
    curriculum: Curriculum
    progress: Progress


class TrainingLoop:
    """A training that is prepared, with its run folder."""

    def __init__(self, learner: Learner, evaluator: Evaluator, saver: Saver, display: Display) -> None:
        self.recipe = learner.recipe
        self.rollouts = learner.rollouts
        self.curriculum = learner.curriculum
        self.progress = learner.progress
        self.saver = saver
        self.stop_signal: int | None = None
        """The number of the signal that asks to stop at the next boundary."""
        self._model: Any = learner.rollouts.model
        self._env = learner.rollouts.env
        self._evaluator = evaluator
        self._display = display
        self._reported: set[str] = set()
        """The findings that were shown."""
        self._stop_announced = False
        self._started = time.monotonic() - self.progress.seconds
        self._last_row = (time.monotonic(), self.steps)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self._model.num_timesteps)

    @property
    def _resume_command(self) -> str:
        return shlex.join(["rlctl", "train", "--resume", str(self.saver.run.path)])

    def run(self) -> None:
        """Play and learn until the recipe's steps are done, or its success rate holds.

        Raises `Interrupted` after a signal, when the state is saved.
        """
        if self.recipe.stages:
            self._display.stage(self.curriculum.title)
        self._display.phase("first steps")
        try:
            self.rollouts.begin(self.recipe.total_timesteps)
            while not self.boundary():
                self.rollouts.advance(self._announce_stop)
                self._display.steps(self.steps)
        except TaskError as error:
            raise self._explain_fault(error) from None
        except ValueError:
            self._check_finite()  # SB3 notices NaN weights by a distribution's complaint
            raise

    def boundary(self) -> bool:
        """Do what is due between two updates and was not done before a resume; return whether nothing is left to do.

        Raises `ArtifactError` if what the training ends with cannot be saved.
        """
        steps, progress = self.steps, self.progress
        is_last = steps >= self.recipe.total_timesteps
        self._take_ended()
        if steps == 0:
            self._begin()
            return False
        stage_done = self.curriculum.is_due(steps)
        if is_last or stage_done or self.recipe.algo in ON_POLICY or steps >= progress.next_row:
            self._write_metrics()
        if stage_done:  # also at the end: for a resume that makes the run longer
            self._begin_next_stage()
        self._stop_if_requested()
        if steps >= progress.next_eval or (is_last and progress.last_eval < steps):
            self.evaluate()
        if is_last or (self.recipe.stop_success is not None and progress.good_in_a_row >= 2):
            self._compare_best_with_last()
            self._save_the_end()
            return True
        self._stop_if_requested()
        if self.saver.checkpoint_is_due():
            self.save_checkpoint()
        return False

    def _begin(self) -> None:
        """Save what the training begins with: better to know now what cannot be saved than after the first update."""
        if self.saver.saved_step is None:
            if self.progress.next_eval == 0:
                self.evaluate()
            self.save_checkpoint()

    def _take_ended(self) -> None:
        env, progress = self._env, self.progress
        ended, env.ended = env.ended, []
        progress.recent += ended
        self.curriculum.count(ended)
        if env.outside and not progress.observations_outside:
            self._display.message(
                f"warning: {env.outside_message}; such observations are counted, and taken as they are"
            )
        progress.observations_outside += env.outside
        env.outside = 0

    def _begin_next_stage(self) -> None:
        self._env.workers.rebuild(self.curriculum.next_spec())
        begin_next_episodes(self._model)
        self._display.stage(*self.curriculum.enter_next_stage(self.steps))

    def _announce_stop(self) -> None:
        """Show, once, that a signal has been taken."""
        if self.stop_signal is not None and not self._stop_announced:
            self._stop_announced = True
            self._display.message(
                "stopping after this update, with a checkpoint; press Ctrl-C again to stop immediately"
            )

    def _stop_if_requested(self) -> None:
        if self.stop_signal is None:
            return
        state = "checkpoint saved" if self.save_checkpoint() else "the last saved checkpoint stands"
        raise Interrupted(
            f"interrupted at step {self.steps:,}; {state}. Go on with: {self._resume_command}",
            self.stop_signal,
        )

    def _write_metrics(self) -> None:
        """Write a row of metrics, and the same to TensorBoard, if there were steps since the last one."""
        steps, progress, logger = self.steps, self.progress, self._model.logger
        if steps <= progress.last_row:
            return
        self._check_finite()
        now = time.monotonic()
        before, steps_before = self._last_row
        self._last_row = (now, steps)
        elapsed = max(now - before, 1e-9)
        recent, progress.recent = progress.recent, []
        row = {
            "steps": steps,
            "seconds": round(now - self._started, 3),
            "fps": round((steps - steps_before) / elapsed, 1),
            "playing": round(self._env.waited_s / elapsed, 3),
            **self.curriculum.columns(),
            **measurements.training_row(recent, self._env.workers.info.reward_weights, logger.name_to_value),
            **measurements.measure(self._model, self._env, progress.last_row, self.recipe.total_timesteps),
        }
        self._env.waited_s = 0.0
        self.saver.row(self.saver.metrics, row)
        for name, value in measurements.tensorboard_values(row).items():
            logger.record(name, value)
        self._model.dump_logs()
        self._display.metrics(row)
        progress.last_row = steps
        progress.next_row = steps + max(1, self.recipe.total_timesteps // _OFF_POLICY_ROWS)

    def evaluate(self) -> None:
        """Play the evaluation episodes, save the best policy, and write the row and the episodes.

        An environment that fails costs this evaluation, not the training.
        """
        steps, began = self.steps, time.monotonic()
        policy = self._pack()
        self._display.phase("evaluating")
        try:
            # They may take minutes, too long to wait after a signal; the resumed run repeats them.
            episodes = self._evaluator.run(policy, self._stop_if_requested)
        except (TaskError, UsageError, ArtifactError) as error:  # the last two where files were removed meanwhile
            self._note_failed_evaluation(error)
        else:
            self._note_evaluation(episodes, policy)
        self.progress.last_eval = steps
        if steps < self.recipe.total_timesteps:  # at the end all of it is said
            self._report_findings()
        while self.progress.next_eval <= steps:
            self.progress.next_eval += self.recipe.eval.every_steps or self.recipe.total_timesteps
        # The rate of training is without the time of evaluations.
        self._last_row = (self._last_row[0] + time.monotonic() - began, self._last_row[1])

    def _report_findings(self) -> None:
        """Show the warnings of the run's own records that were not there the last time."""
        for finding in diagnose(self.saver.run):
            if finding.grade == Grade.WARNING and finding.id not in self._reported:
                self._reported.add(finding.id)
                self._display.message(finding.line)

    def _note_failed_evaluation(self, error: RlctlError) -> None:
        progress, steps = self.progress, self.steps
        progress.failed_evaluations += 1
        progress.first_failure = progress.first_failure or f"at step {steps:,}: {error}"
        error = self._evaluator.keep_failed(error, self.curriculum.goal_spec, steps)
        self._display.message(f"warning: evaluation at step {steps:,} failed, training goes on: {error}")

    def _note_evaluation(self, episodes: list[Episode], policy: PolicyFile) -> None:
        progress, steps, logger = self.progress, self.steps, self._model.logger
        results = [episode.result for episode in episodes]
        success, mean = success_rate(results), mean_return(results)
        better = progress.is_better(success, mean)
        if better:
            self._keep_as_best(policy, success, mean)
        threshold = self.recipe.stop_success
        good = threshold is not None and success is not None and success >= threshold
        progress.good_in_a_row = progress.good_in_a_row + 1 if good else 0
        row = {
            "steps": steps,
            "seconds": round(time.monotonic() - self._started, 3),
            **self.curriculum.columns(),
            **measurements.evaluation_row(results),
        }
        self.saver.row(self.saver.evals, row)
        logger.record("eval/mean_reward", mean)
        if success is not None:
            logger.record("eval/success_rate", success)
        logger.dump(steps)
        self.saver.attempt("episodes", lambda: self._evaluator.keep(episodes, steps))
        self._display.evaluation(steps, success, mean, better)

    def _compare_best_with_last(self) -> None:
        """Take the last policy for the best if new episodes say so.

        The best of many evaluations is the luckiest of them, too: chosen by 8 episodes, one policy of a hopper had
        2,612, and 2,386 in a hundred others, where the last had 2,579.
        """
        progress, steps = self.progress, self.steps
        rows = read_table(self.saver.run.evals_file)
        if progress.best_step in (None, steps) or not rows or rows[-1]["steps"] != steps:
            return  # the last is the best, or could not be evaluated
        count = max(_FINAL_EPISODES, self.recipe.eval.episodes)
        self._display.phase("best or last")
        last = self._pack()
        try:
            before, after = (self._score_anew(each, count) for each in (self.saver.read_best(), last))
        except (TaskError, UsageError, ArtifactError) as error:
            self._display.message(f"warning: the best and the last policy were not compared: {error}")
            return
        last_is_better = (after[0] or 0.0, after[1]) > (before[0] or 0.0, before[1])
        self._display.message(
            f"{count} new episodes: {format_score(*before)} at step {progress.best_step:,}, {format_score(*after)} "
            f"at the last; {'the last' if last_is_better else 'that of before'} is kept as best"
        )
        if last_is_better:
            self._keep_as_best(last, rows[-1]["success"], rows[-1]["return"] or 0.0)

    def _score_anew(self, policy: PolicyFile, episodes: int) -> tuple[float | None, float]:
        """Return the success rate and the mean return of a policy in new episodes."""
        played = self._evaluator.run(policy, self._stop_if_requested, unseen=episodes)
        results = [episode.result for episode in played]
        return success_rate(results), mean_return(results)

    def _keep_as_best(self, policy: PolicyFile, success: float | None, mean: float) -> None:
        self.saver.save_best(policy.with_info(evaluation=Score(success=success, mean_return=mean)))
        progress = self.progress
        progress.best_success, progress.best_return, progress.best_step = success, mean, self.steps

    def _pack(self) -> PolicyFile:
        policy = pack(self._model, self.recipe.algo, self.curriculum.goal_spec, self.curriculum.goal)
        return policy.with_info(stages=self.curriculum.specs())

    def save_checkpoint(self) -> bool:
        """Write a checkpoint of the present boundary; False, with a warning, if the disk does not take it."""
        self._check_finite()
        self.progress.seconds = time.monotonic() - self._started
        return self.saver.checkpoint(self._pack, self.progress)

    def _check_finite(self) -> None:
        check_finite(self._model, self.saver.run.path)

    def _save_the_end(self) -> None:
        self.progress.done = True
        # Once more: after the last checkpoint there is no next one.
        if not self.save_checkpoint() and not self.save_checkpoint():
            raise ArtifactError(
                f"{self.saver.run.path}: the training is done, but could not be saved: {self.saver.problem}"
            )

    def _explain_fault(self, error: TaskError) -> TaskError:
        """Keep the actions of the training episode that failed, and return the error with what to do next."""
        lines = [str(self._evaluator.keep_failed(error, self._env.workers.spec))]
        if step := self.saver.saved_step:  # at step 0 there is nothing to keep
            lines.append(f"the checkpoint of step {step:,} stands; go on with: {self._resume_command}")
        return TaskError("\n".join(lines), details=error.details)

    def write_end(self, recordings: int) -> list[Path]:
        """Write that the training is done; return the requested recordings of the last evaluation's episodes."""
        for _ in range(2):  # once more, if the disk has not taken it
            if self.saver.attempt("run.json", lambda: status.write_end(self.saver.run, self.steps, self.progress)):
                break
        return self._evaluator.record(recordings)
