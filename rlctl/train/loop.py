"""What happens at the boundaries between updates: metrics, evaluation, checkpoints, stopping.

SB3 calls `on_rollout_start` after each update and before the next step. All of rlctl's own work is done there, so
that a checkpoint never falls inside a rollout, and a run can be resumed.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from rlctl.errors import ArtifactError, DivergedError, Interrupted
from rlctl.eval.statistics import mean_return, mean_terms, success_rate
from rlctl.rollout.collect import Episode, run_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import EpisodeResult, Workers
from rlctl.run.directory import RunDirectory
from rlctl.run.policy import BatchActor, PolicyInfo, save_policy
from rlctl.run.recipe import ON_POLICY, Recipe
from rlctl.run.torch_policy import Normalizer, TorchPolicy
from rlctl.train import checkpoint
from rlctl.train.curriculum import Curriculum, begin_next_episodes
from rlctl.train.display import Display
from rlctl.train.episodes import EpisodeKeeper
from rlctl.train.pack import pack
from rlctl.train.progress import Progress, append_row, table_size
from rlctl.train.vec_env import WorkerVecEnv

_LOSSES = (
    "learning_rate", "loss", "policy_gradient_loss", "policy_loss", "value_loss", "entropy_loss", "approx_kl",
    "clip_fraction", "clip_range", "explained_variance", "std", "actor_loss", "critic_loss", "ent_coef",
    "ent_coef_loss", "n_updates",
)  # fmt: skip
# Explained variance, for one, is not a number where rewards are constant, and nothing is wrong.
_MUST_BE_FINITE = ("loss", "value_loss", "policy_gradient_loss", "policy_loss", "actor_loss", "critic_loss")
_OFF_POLICY_ROWS = 200  # rows of metrics a training has, about: off-policy updates come at every step


class TrainingStopped(Exception):
    """Ends SB3's `learn` at a boundary; nothing is wrong."""


class TrainingLoop(BaseCallback):
    """Runs at every boundary; raises `TrainingStopped` when the recipe's success rate holds."""

    def __init__(
        self,
        run: RunDirectory,
        recipe: Recipe,
        env: WorkerVecEnv,
        eval_workers: Workers,
        progress: Progress,
        display: Display,
        curriculum: Curriculum,
    ) -> None:
        super().__init__()
        self.run_directory = run
        self.recipe = recipe
        self.env = env
        self.progress = progress
        self.display = display
        self.curriculum = curriculum
        self.stop_signal: int | None = None
        self.episodes = EpisodeKeeper(run, curriculum.goal_spec, curriculum.goal)
        self._eval_workers = eval_workers
        self._started = time.monotonic() - progress.seconds
        self._last_row = (time.monotonic(), 0)
        self._next_row = 0
        self._recent: list[EpisodeResult] = []
        self._boundary_steps = 0
        self._unsaved: str | None = None

    def _on_step(self) -> bool:
        self.display.steps(self.num_timesteps)
        return True

    def _on_training_start(self) -> None:
        self._started_at = self.model.num_timesteps
        self._last_row = (time.monotonic(), self._started_at)
        self._next_row = self._started_at

    def _on_rollout_start(self) -> None:
        # The first boundary comes before any step, or right after a resume, and repeats what is there.
        first = self.model.num_timesteps == self._started_at
        self._boundary_steps = self.model.num_timesteps
        if not first:
            self.boundary()

    def boundary(self) -> None:
        """Do everything that is due after an update."""
        steps = self.model.num_timesteps
        self._take_ended()
        stage_done = self.curriculum.is_due(steps)
        on_policy = self.recipe.algo in ON_POLICY
        if on_policy or steps >= self._next_row or stage_done:
            self.check_finite()
            self._write_metrics(steps)
            self._next_row = steps + max(1, self.recipe.total_timesteps // _OFF_POLICY_ROWS)
        if stage_done:
            self._begin_next_stage(steps)
        self._stop_if_asked()
        if steps >= self.progress.next_eval:
            self.evaluate()
            self.save_checkpoint()
            self._stop_if_asked()
            if self.recipe.stop_success is not None and self.progress.good_in_a_row >= 2:
                raise TrainingStopped

    def _take_ended(self) -> None:
        ended = self.env.take_ended()
        self._recent += ended
        self.curriculum.count(ended)
        if warning := self.curriculum.warning():
            self.display.message(warning)

    def _begin_next_stage(self, steps: int) -> None:
        self.env.workers.rebuild(self.curriculum.next_spec())
        begin_next_episodes(self.model)
        self.display.stage(*self.curriculum.go_on(steps))

    def _stop_if_asked(self) -> None:
        if self.stop_signal is None:
            return
        saved = self.save_checkpoint()
        told = "checkpoint saved" if saved else "the last saved checkpoint stands"
        raise Interrupted(
            f"interrupted at step {self.model.num_timesteps:,}; {told}. Go on with: "
            f"rlctl train --resume {self.run_directory.path}",
            self.stop_signal,
        )

    def finish(self) -> None:
        """Evaluate and save what the training ended with; raises `ArtifactError` if it cannot be saved."""
        self._boundary_steps = self.model.num_timesteps
        self.check_finite()
        self._take_ended()
        self._write_metrics(self.model.num_timesteps)
        if self.curriculum.is_due(self.model.num_timesteps):  # for a resume that makes the run longer
            self.display.stage(*self.curriculum.go_on(self.model.num_timesteps))
        self.evaluate()
        self.logger.dump(self.model.num_timesteps)
        if not self.save_checkpoint():
            raise ArtifactError(
                f"{self.run_directory.path}: the training is done, but could not be saved: {self._unsaved}"
            )

    def save_after_fault(self) -> None:
        """Save the last boundary: what was collected since is lost, the network is still that of the boundary."""
        if self._boundary_steps > 0:
            self.model.num_timesteps = self._boundary_steps
            self.save_checkpoint()

    def check_finite(self) -> None:
        """Raise `DivergedError` if a weight or a loss is not finite."""
        for name, parameter in self.model.policy.named_parameters():
            if not bool(torch.isfinite(parameter).all()):
                raise self._diverged(f"weights {name} are")
        losses = self.logger.name_to_value
        for name in _MUST_BE_FINITE:
            if not math.isfinite(losses.get(f"train/{name}", 0.0)):
                raise self._diverged(f"{name} is")

    def _diverged(self, what: str) -> DivergedError:
        return DivergedError(
            f"training diverged: {what} not finite at step {self.model.num_timesteps:,}. A smaller "
            "algo_kwargs.learning_rate or a smaller reward helps most often.\n"
            f"What was saved before is in {self.run_directory.path}"
        )

    def _write_metrics(self, steps: int) -> None:
        now = time.monotonic()
        before, steps_before = self._last_row
        self._last_row = (now, steps)
        row: dict[str, Any] = {
            "steps": steps,
            "seconds": round(now - self._started, 3),
            "fps": round((steps - steps_before) / max(now - before, 1e-9), 1),
            **self.curriculum.columns(),
        }
        terms = dict.fromkeys(self.env.workers.info.reward_weights)
        row.update({"return": None, "length": None, "success": None})
        if self._recent:
            row["return"] = mean_return(self._recent)
            row["length"] = float(np.mean([result.length for result in self._recent]))
            row["success"] = success_rate(self._recent)
            known = mean_terms(self._recent)
            terms.update({name: known.get(name) for name in terms})
        row.update({f"term/{name}": value for name, value in terms.items()})
        losses = self.logger.name_to_value
        row.update({name: losses.get(f"train/{name}") for name in _LOSSES})
        self._saving("metrics", lambda: append_row(self.run_directory.metrics_file, row))
        for name, number in self.curriculum.columns().items():
            self.logger.record(f"curriculum/{name}", number)
        for name, value in terms.items():
            if value is not None:
                self.logger.record(f"reward_terms/{name}", value)
        self.display.metrics(steps, row["fps"], row["return"], row["success"])
        self._recent = []

    def evaluate(self) -> None:
        """Live the evaluation episodes, keep the best policy, and write the row and the episodes."""
        steps, began = self.model.num_timesteps, time.monotonic()
        packed = self._pack()
        episodes = self._live_episodes(*packed)
        results = [episode.result for episode in episodes]
        success, mean = success_rate(results), mean_return(results)
        progress = self.progress
        better = self._is_better(success, mean)
        if better and self._saving("best policy", lambda: save_policy(self.run_directory.best_policy, *packed)):
            progress.best_success, progress.best_return, progress.best_step = success, mean, steps
        threshold = self.recipe.stop_success
        good = threshold is not None and success is not None and success >= threshold
        progress.good_in_a_row = progress.good_in_a_row + 1 if good else 0
        progress.last_eval_step = steps
        while progress.next_eval <= steps:
            progress.next_eval += self.recipe.eval.every_steps or self.recipe.total_timesteps
        row = {
            "steps": steps,
            "seconds": round(time.monotonic() - self._started, 3),
            **self.curriculum.columns(),
            "episodes": len(results),
            "success": success,
            "return": mean,
            "length": float(np.mean([result.length for result in results])),
            **{f"term/{name}": value for name, value in mean_terms(results).items()},
        }
        self._saving("evaluation", lambda: append_row(self.run_directory.evals_file, row))
        self.logger.record("eval/mean_reward", mean)
        if success is not None:
            self.logger.record("eval/success_rate", success)
        self._saving("episodes", lambda: self.episodes.keep(episodes, steps))
        self.display.evaluation(steps, success, mean, better)
        # The rate of training is without the time of evaluations.
        self._last_row = (self._last_row[0] + time.monotonic() - began, steps)

    def _pack(self) -> tuple[PolicyInfo, dict[str, Any]]:
        goal = self.curriculum
        return pack(self.model, self.recipe.algo, goal.goal_spec, goal.goal, goal.contents())

    def _live_episodes(self, info: PolicyInfo, tensors: dict[str, Any]) -> list[Episode]:
        was_training = self.model.policy.training
        policy = TorchPolicy(info, self.model.policy, Normalizer(info, tensors))
        count = self.recipe.eval.episodes
        seeds = episode_seeds(self.recipe.seed, Stream.EVAL_IN_TRAINING, count)
        actor = BatchActor(policy, self._eval_workers.n_envs)
        episodes = run_episodes(self._eval_workers, actor, seeds, record=True)
        self.model.policy.set_training_mode(was_training)
        return episodes

    def _is_better(self, success: float | None, mean: float) -> bool:
        best = self.progress
        if best.best_step is None:
            return True
        if success is not None and best.best_success is not None and success != best.best_success:
            return success > best.best_success
        return best.best_return is None or mean > best.best_return

    def save_checkpoint(self) -> bool:
        """Write a checkpoint of the present boundary; False, with a warning, if the disk does not take it."""
        progress = self.progress
        progress.seconds = time.monotonic() - self._started
        progress.metrics_bytes = table_size(self.run_directory.metrics_file)
        progress.evals_bytes = table_size(self.run_directory.evals_file)
        progress.episodes_started = list(self.env.episodes_started)
        packed = self._pack()
        return self._saving(
            "checkpoint",
            lambda: self._save(packed, dataclasses.asdict(progress)),
        )

    def _save(self, packed: Any, progress: dict[str, Any]) -> None:
        save_policy(self.run_directory.last_policy, *packed)
        checkpoint.save(self.run_directory, self.model, packed, progress, self.recipe.checkpoint.keep)

    def _saving(self, what: str, write: Callable[[], object]) -> bool:
        """Write something; a disk that does not take it costs a warning, and the next boundary tries again."""
        try:
            write()
        except OSError as error:
            self._unsaved = f"{what}: {error.strerror or error}"
            self.display.message(f"warning: not saved: {self._unsaved}; training goes on")
            return False
        return True
