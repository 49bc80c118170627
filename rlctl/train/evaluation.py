"""Evaluation while training: the same episodes each time, in environments of their own."""

from __future__ import annotations

from collections.abc import Callable

from rlctl.rollout.collect import Episode, play_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers
from rlctl.run.acting import Exploration
from rlctl.run.policy import PolicyInfo
from rlctl.run.recipe import Recipe
from rlctl.train.snapshot import Tensors


class Evaluator:
    """Plays the evaluation episodes of a run; nothing of the training changes by it."""

    def __init__(self, recipe: Recipe, make_workers: Callable[[], Workers]) -> None:
        self._recipe = recipe
        self._make_workers = make_workers
        # They build their environments beside the first updates, which leave a core idle.
        self._workers: Workers | None = make_workers()

    def run(self, info: PolicyInfo, tensors: Tensors, check: Callable[[], None]) -> list[Episode]:
        """Return the episodes of a policy.

        `check` is called several times a second and may raise to leave. Raises `TaskError` if an environment fails;
        the next call begins with new environments.
        """
        settings = self._recipe.eval
        workers = self._workers = self._workers or self._make_workers()
        seeds = episode_seeds(self._recipe.seed, Stream.EVAL_IN_TRAINING, settings.episodes)
        try:
            workers.set_policy(info, tensors)
            exploration = Exploration(stochastic=not settings.deterministic)
            return play_episodes(workers, seeds, exploration, record=True, check=check)
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """End the environments' processes."""
        if self._workers is not None:
            self._workers.close()
        self._workers = None
