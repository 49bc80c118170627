"""Evaluations while training, and the best policy: when to evaluate, what is written, and which policy is kept."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, EpisodeFailed, RlctlError, TaskError, UsageError
from rlctl.evaluation.episode_statistics import mean_return, success_rate
from rlctl.play.collect import Episode, play_episodes
from rlctl.play.episode import STEP_LABEL, EpisodeInfo, RecordedEpisode, save_next_episode
from rlctl.play.seeds import Stream, episode_seeds
from rlctl.play.workers import Workers
from rlctl.policy.actor import Exploration
from rlctl.policy.file import PolicyFile, PolicyInfo, Score
from rlctl.runs.best import is_better
from rlctl.runs.tables import read_table
from rlctl.training import measurements
from rlctl.training.checkpoints import Checkpoints
from rlctl.training.display import Display, format_score
from rlctl.training.learner import Learner
from rlctl.version import collect_versions

_FINAL_EPISODES = 30  # minimum number of new episodes that compare the best policy with the last


class EvaluationEpisodes:
    """Plays the evaluation episodes of a run, and saves some of them, without any effect on the training."""

    def __init__(self, learner: Learner, make_workers: Callable[[], Workers], checkpoints: Checkpoints) -> None:
        self._recipe = learner.recipe
        self._make_workers = make_workers
        self._checkpoints = checkpoints
        self._goal = learner.curriculum.goal  # description of the environments of the evaluations
        # They build their environments during the first updates, which leave a core idle.
        self._workers: Workers | None = make_workers()
        self._spec = self._workers.spec
        self._latest: list[RecordedEpisode] = []

    def play(self, policy: PolicyFile, watch: Callable[[], None], *, unseen: int | None = None) -> list[Episode]:
        """Play and return the episodes of every evaluation, or `unseen` new ones; `watch` may raise to stop."""
        settings = self._recipe.eval
        workers = self._workers = self._workers or self._make_workers()
        usual = settings.episodes
        seed = self._recipe.seed if self._recipe.eval.seed is None else self._recipe.eval.seed
        seeds = episode_seeds(seed, Stream.EVAL_IN_TRAINING, usual + (unseen or 0))
        seeds = seeds[:usual] if unseen is None else seeds[usual:]
        try:
            workers.set_policy(policy)
            exploration = Exploration(stochastic=not settings.deterministic)
            return play_episodes(workers, seeds, exploration, record=True, watch=lambda _: watch())
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Stop the environments' processes."""
        if self._workers is not None:
            self._workers.close()
        self._workers = None

    def keep(self, episodes: list[Episode], steps: int) -> None:
        """Save the first and the worst episode of an evaluation; remember all for `record`."""
        policy = f"{STEP_LABEL}{steps}"
        self._latest = recorded = [episode.describe(self._spec, self._goal, policy) for episode in episodes]
        scores = [(episode.result.success is True, episode.result.total_reward) for episode in episodes]
        for index in dict.fromkeys((0, scores.index(min(scores)))):
            save_next_episode(self._checkpoints.run.episodes, recorded[index])

    def save_last(self, count: int) -> list[Path]:
        """Save the last `count` episodes of the last evaluation; return their files."""
        latest = self._latest[-count:] if count else []
        return [save_next_episode(self._checkpoints.run.episodes, episode) for episode in latest]

    def keep_failed(self, error: RlctlError, spec: EnvSpec, evaluated_at: int | None = None) -> RlctlError:
        """Save the actions of a failed episode of `spec`, if known; return the error with a hint at the file."""
        if not isinstance(error, EpisodeFailed) or error.actions is None:
            return error
        info = EpisodeInfo(
            spec=spec,
            seed=error.seed,
            policy="training" if evaluated_at is None else f"{STEP_LABEL}{evaluated_at}",
            total_reward=0.0,
            versions=collect_versions(),
            failure=str(error).partition("\n")[0],
        )
        nothing = np.zeros(0)
        shape = self._goal.spaces()[1].shape or ()
        actions = np.asarray(error.actions).reshape(-1, *shape)  # if the reset failed there are no actions
        episode = RecordedEpisode(actions, nothing, nothing, nothing.reshape(0, 0), info)
        written: list[Path] = []
        folder = self._checkpoints.run.episodes
        self._checkpoints.attempt("failed episode", lambda: written.append(save_next_episode(folder, episode)))
        return error.with_hint(f"to reproduce it: rlctl replay {shlex.quote(str(written[0]))}") if written else error


class Evaluator:
    """Evaluates the policy of a learner and keeps the best one; `watch` may raise at any time to stop the episodes."""

    def __init__(
        self, learner: Learner, episodes: EvaluationEpisodes, checkpoints: Checkpoints, display: Display
    ) -> None:
        self.episodes = episodes
        self.best: PolicyInfo | None = None  # the best policy so far, with its score, as stored in its file
        self._learner = learner
        self._recipe = learner.recipe
        self._checkpoints = checkpoints
        self._display = display
        self._highest_success = 0.0  # of all evaluations so far

    def restore(self) -> None:
        """Read the best score from the best policy's file, which may be newer than the checkpoint."""
        rows = read_table(self._checkpoints.run.evals_file)
        self._highest_success = max((row["success"] for row in rows if row["success"] is not None), default=0.0)
        try:
            self.best = self._checkpoints.read_best().info
        except ArtifactError as error:
            if rows:
                self._display.message(f"warning: {error}; the next evaluated policy becomes the best")

    def is_due(self) -> bool:
        """Return whether to evaluate at this boundary: every `eval.every_steps` steps, and at the end."""
        steps, progress = self._learner.steps, self._learner.progress
        return steps >= progress.next_eval or (self._learner.is_at_end and progress.last_eval < steps)

    def evaluate(self, watch: Callable[[], None]) -> dict[str, Any]:
        """Play, save the best policy, write the row and the episodes; return the row, empty after a failure."""
        row: dict[str, Any] = {}
        steps, progress = self._learner.steps, self._learner.progress
        policy = self._learner.pack()
        self._display.phase("evaluating")
        try:
            # Episodes may take minutes, so a signal interrupts them; the resumed run repeats them.
            episodes = self.episodes.play(policy, watch)
        except (TaskError, UsageError, ArtifactError) as error:  # the last two: files were removed in the meantime
            self._note_failure(error)
        else:
            row = self._note(episodes, policy)
        progress.last_eval = steps
        while progress.next_eval <= steps:
            progress.next_eval += self._recipe.eval.every_steps or self._recipe.total_timesteps
        return row

    def _note_failure(self, error: RlctlError) -> None:
        progress, steps = self._learner.progress, self._learner.steps
        progress.failed_evaluations += 1
        progress.first_failure = progress.first_failure or f"at step {steps:,}: {error}"
        error = self.episodes.keep_failed(error, self._learner.curriculum.goal_spec, steps)
        self._display.message(f"warning: evaluation at step {steps:,} failed, training continues: {error}")

    def _note(self, episodes: list[Episode], policy: PolicyFile) -> dict[str, Any]:
        learner, steps = self._learner, self._learner.steps
        results = [episode.result for episode in episodes]
        score = _score(episodes)
        better = self._is_better(score, len(results))
        self._highest_success = max(self._highest_success, score.success or 0.0)
        if better:
            self._keep_as_best(policy, score)
        threshold = self._recipe.stop_success
        is_good = threshold is not None and score.success is not None and score.success >= threshold
        learner.progress.good_in_a_row = learner.progress.good_in_a_row + 1 if is_good else 0
        row = {
            "steps": steps,
            "seconds": round(learner.seconds, 3),
            **learner.curriculum.columns(),
            **measurements.evaluation_row(results),
        }
        self._checkpoints.row(self._checkpoints.evals, row)
        tags = {"mean_reward": row["return"], "mean_ep_length": row["length"], "success_rate": row["success"]}
        for tag, value in tags.items():  # those of SB3's own evaluations
            if value is not None:
                learner.model.logger.record(f"eval/{tag}", value)
        learner.model.logger.dump(steps)
        self._checkpoints.attempt("episodes", lambda: self.episodes.keep(episodes, steps))
        self._display.evaluation(steps, score.success, score.mean_return, better)
        return row

    def compare_best_with_last(self, watch: Callable[[], None]) -> None:
        """Play new episodes with the best and the last policy; keep the last as best if it is better in them.

        The highest score of many evaluations is partly luck: a hopper's best policy scored 2,612 in 8 episodes, but
        2,386 in a hundred others, where the last policy scored 2,579.
        """
        steps, best = self._learner.steps, self.best
        rows = read_table(self._checkpoints.run.evals_file)
        if best is None or best.training_steps == steps or not rows or rows[-1]["steps"] != steps:
            return  # the last policy is the best already, or was not evaluated
        count = max(_FINAL_EPISODES, self._recipe.eval.episodes)
        self._display.phase("best or last")
        last = self._learner.pack()
        try:
            before = _score(self.episodes.play(self._checkpoints.read_best(), watch, unseen=count))
            after = _score(self.episodes.play(last, watch, unseen=count))
        except (TaskError, UsageError, ArtifactError) as error:
            self._display.message(f"warning: the best and the last policy were not compared: {error}")
            return
        last_is_better = is_better(after, before, before.success or 0.0, count)
        self._display.message(
            f"{count} new episodes: {format_score(before.success, before.mean_return)} at step "
            f"{best.training_steps:,}, {format_score(after.success, after.mean_return)} at the last; "
            f"{'the last' if last_is_better else 'the previous best'} is kept as best"
        )
        if last_is_better:
            self._keep_as_best(last, Score(success=rows[-1]["success"], mean_return=rows[-1]["return"] or 0.0))

    def _is_better(self, score: Score, episodes: int) -> bool:
        if self.best is not None and self.best.training_steps > self._learner.steps:
            return False  # a resumed run repeats this evaluation; a later best policy is already stored
        return is_better(score, self.best.evaluation if self.best else None, self._highest_success, episodes)

    def _keep_as_best(self, policy: PolicyFile, score: Score) -> None:
        best = policy.with_info(evaluation=score)
        self._checkpoints.save_best(best)
        self.best = best.info


def _score(episodes: list[Episode]) -> Score:
    results = [episode.result for episode in episodes]
    return Score(success=success_rate(results), mean_return=mean_return(results))
