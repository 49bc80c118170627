"""Behaviour cloning: before the training, and off-policy in its first part too, an actor learns from demonstrations.

The library `imitation` is not used: its newest release, 1.0.1, needs gymnasium 0.29 and Stable-Baselines3 2.2.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from rlctl.environments.dict_spaces import join, split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError
from rlctl.output import format_count
from rlctl.policy.file import list_actor_tensors
from rlctl.recipe.recipe import ON_POLICY
from rlctl.training.demonstrations import Demonstration, describe_source, read_demonstrations
from rlctl.training.rollouts import Rollouts, to_network_layout
from rlctl.training.snapshot import observation_statistics
from rlctl.training.start import Start

REHEARSAL_SHARE = 0.25
"""Share of an off-policy training in which the actor goes on learning from the demonstrations, less and less."""
_UPDATES, _BATCH, _RATE = 3000, 256, 1e-3
_STD = 0.1  # exploration after cloning; the entropy of such noise is about SAC's target
_CONSTANT = 1e-8  # variance below which an observation counts as constant


def clone(start: Start, rollouts: Rollouts, env: EnvInfo, show: Callable[[str], None]) -> None:
    """Clone the demonstrations of a new training, `show` the result, and set up their repetition where it is due.

    Raises `ArtifactError` if a resumed training needs demonstrations that have changed.
    """
    recipe, path = start.recipe, Path(str((start.demos or {})["path"]))
    rehearses = recipe.algo not in ON_POLICY and start.step < REHEARSAL_SHARE * recipe.total_timesteps
    if start.checkpoint is not None and not rehearses:
        return
    if start.run is not None and describe_source(path) != start.demos:
        raise ArtifactError(f"{path}: the demonstrations have changed since this training began; put them back")
    cloning = Cloning(read_demonstrations(path, start.task, env), rollouts.model, recipe.total_timesteps)
    if rehearses:
        rollouts.rehearse = cloning.rehearse
    if start.checkpoint is None:
        show(cloning.clone(recipe.algo))


class Cloning:
    """Demonstrations, and the model whose actor learns to act as they do."""

    def __init__(self, demonstrations: list[Demonstration], model: Any, total_timesteps: int) -> None:
        self._model = model
        self._total_timesteps = total_timesteps
        self._episodes = len(demonstrations)
        self._observations = {
            key: np.concatenate([episode.observations[key] for episode in demonstrations])
            for key in split_space(model.observation_space)
        }
        self._actions = np.concatenate([episode.actions for episode in demonstrations])

    def clone(self, algo: str) -> str:
        """Set the normalisation, the actor and its noise; return a message."""
        model = self._model
        for key, moments in observation_statistics(model.get_vec_normalize_env()).items():
            rows = self._observations[key]
            var = rows.var(0, dtype=np.float64)
            moments.mean[...], moments.var[...] = rows.mean(0), np.where(var < _CONSTANT, 1.0, var)
            moments.count = float(self._total_timesteps)  # the actor depends on them, so they must change slowly
        named = {f"policy/{name}": parameter for name, parameter in model.policy.named_parameters()}
        optimizer = torch.optim.Adam([named[name] for name in list_actor_tensors(algo, named)], _RATE)
        schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, _UPDATES)
        self._imitate(optimizer, _UPDATES, 1.0, schedule)
        model.policy.set_training_mode(False)
        with torch.no_grad():
            loss = float(self._compute_loss(slice(None)))
            _set_noise(model)
        is_box = isinstance(model.action_space, spaces.Box)
        error = f"mean error {math.sqrt(loss):.3f}" if is_box else f"loss {loss:.3f}"
        return f"cloned {format_count(self._episodes, 'demonstration')} ({len(self._actions):,} steps, {error})"

    def rehearse(self, updates: int) -> None:
        """Learn from the demonstrations after off-policy updates, whose new critic would else spoil the actor.

        The weight of the loss grows with the values, as in TD3+BC, https://arxiv.org/abs/2106.06860.
        """
        model = self._model
        share = 1.0 - model.num_timesteps / (REHEARSAL_SHARE * self._total_timesteps)
        if (count := round(updates * share)) > 0:
            with torch.no_grad():
                values = torch.cat([*model.critic(*self._to_tensors(slice(_BATCH)))])
            self._imitate(model.actor.optimizer, count, 10.0 * (1.0 + float(values.abs().mean())))

    def _imitate(self, optimizer: torch.optim.Optimizer, updates: int, weight: float, schedule: Any = None) -> None:
        model = self._model
        rng = np.random.default_rng([model.seed, model.num_timesteps])
        model.policy.set_training_mode(True)
        for _ in range(updates):
            optimizer.zero_grad(set_to_none=False)  # `training/updates` shares the memory of the gradients
            torch.autograd.backward(weight * self._compute_loss(rng.integers(len(self._actions), size=_BATCH)))
            optimizer.step()
            if schedule is not None:
                schedule.step()

    def _to_tensors(self, rows: Any) -> tuple[Any, torch.Tensor]:
        model, actions = self._model, self._actions[rows]
        observations = join({key: part[rows] for key, part in self._observations.items()})
        if (normalizer := model.get_vec_normalize_env()) is not None:
            observations = normalizer.normalize_obs(observations)
        parts, network_spaces = split(observations), split_space(model.observation_space)
        inputs = {
            key: torch.as_tensor(to_network_layout(parts[key], part), device=model.device)
            for key, part in network_spaces.items()
        }
        if isinstance(model.action_space, spaces.Box):
            actions = (model.policy.scale_action(actions) if model.policy.squash_output else actions).astype(np.float32)
        return join(inputs), torch.as_tensor(actions, device=model.device)

    def _compute_loss(self, rows: Any) -> torch.Tensor:
        """Return the mean squared error of actions, or the negative log-likelihood of discrete ones."""
        model, (observations, targets) = self._model, self._to_tensors(rows)
        if hasattr(model, "actor"):
            actor = model.actor
            chosen = actor(observations, deterministic=True) if hasattr(actor, "log_std") else actor(observations)
        else:
            distribution = model.policy.get_distribution(observations)
            if not isinstance(model.action_space, spaces.Box):
                log_likelihood: torch.Tensor = distribution.log_prob(targets).mean()
                return -log_likelihood
            chosen = distribution.mode()
        return torch.nn.functional.mse_loss(chosen, targets)


def _set_noise(model: Any) -> None:
    """Give the actor a standard deviation of about `_STD` in the states of the last pass."""
    actor = getattr(model, "actor", model.policy)
    log_std = getattr(actor, "log_std", None)
    if isinstance(log_std, torch.nn.Linear):  # SAC without gSDE
        log_std.weight.zero_()
        log_std.bias.fill_(math.log(_STD))
    elif log_std is not None:
        log_std += math.log(_STD) - actor.action_dist.distribution.stddev.log().mean()
    if hasattr(model, "actor_target"):
        model.actor_target.load_state_dict(model.actor.state_dict())
