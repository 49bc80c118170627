"""Evaluation while training: the same episodes each time, in environments of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from rlctl.dict_spaces import Observations
from rlctl.rollout.collect import Actor, Episode, run_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Workers
from rlctl.run.policy import BatchActor, PolicyInfo
from rlctl.run.recipe import Recipe
from rlctl.run.torch_policy import Normalizer, TorchPolicy
from rlctl.train.snapshot import Tensors, isolate_randomness


class Evaluator:
    """Plays the evaluation episodes of a run without a trace in the training."""

    def __init__(self, recipe: Recipe, make_workers: Callable[[], Workers]) -> None:
        self._recipe = recipe
        self._make_workers = make_workers
        # They build their environments beside the first updates, which leave a core idle.
        self._workers: Workers | None = make_workers()

    def run(self, model: BaseAlgorithm, info: PolicyInfo, tensors: Tensors, check: Callable[[], None]) -> list[Episode]:
        """Return the episodes of a model's policy as it is now.

        `check` is called before each step and may raise to leave. Raises `TaskError` if an environment fails;
        the next call begins with new environments.
        """
        settings = self._recipe.eval
        workers = self._workers = self._workers or self._make_workers()
        was_training = model.policy.training
        policy = TorchPolicy(info, model.policy, Normalizer(info, tensors))
        actor = _Watched(BatchActor(policy, workers.n_envs, deterministic=settings.deterministic), check)
        seeds = episode_seeds(self._recipe.seed, Stream.EVAL_IN_TRAINING, settings.episodes)
        chance = np.random.SeedSequence(
            self._recipe.seed, spawn_key=(int(Stream.EVAL_IN_TRAINING), model.num_timesteps)
        ).generate_state(1)
        try:
            with isolate_randomness(model, int(chance[0])):
                return run_episodes(workers, actor, seeds, record=True)
        except Exception:
            self.close()
            raise
        finally:
            model.policy.set_training_mode(was_training)

    def close(self) -> None:
        """End the environments' processes."""
        if self._workers is not None:
            self._workers.close()
        self._workers = None


class _Watched:
    """An actor that calls a check before each step."""

    def __init__(self, actor: Actor, check: Callable[[], None]) -> None:
        self._actor = actor
        self._check = check

    def act(self, observations: Observations, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> NDArray[Any]:
        self._check()
        return self._actor.act(observations, rows, starts)
