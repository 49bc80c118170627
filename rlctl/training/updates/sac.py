"""SAC's updates with gradients computed without autograd: what SB3's `SAC.train` computes, but for rounding.

T. Haarnoja et al., Soft Actor-Critic Algorithms and Applications, 2018, https://arxiv.org/abs/1812.05905.
"""

from __future__ import annotations

import collections
import functools
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3 import SAC
from torch import Tensor

from rlctl.training.updates.mlp import Mlp, is_mlp, share_gradients
from rlctl.training.updates.side_by_side import SideBySide
from rlctl.training.updates.squashed_actor import Sample, SquashedActor

_LOSS_EVERY = 8
"""Of so many updates in a row the first computes the critics' loss, which is only logged and takes TQC a while."""


class SacUpdate:
    """Updates a SAC model whose networks are multi-layer perceptrons."""

    algorithm: ClassVar[Any] = SAC

    def __init__(self, model: Any) -> None:
        self._model = model
        self._actor = SquashedActor(model.actor)
        self._critics, self._targets = (
            [Mlp(network) for network in critic.q_networks] for critic in (model.critic, model.critic_target)
        )
        share_gradients(model.critic.parameters())
        self._side_by_side = SideBySide(self._critics, model.batch_size)
        self._followed = [each.data for each in model.critic.parameters()]
        self._following = [each.data for each in model.critic_target.parameters()]

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether a model can be updated so; otherwise SB3 does it."""
        if type(model) is not cls.algorithm:
            return False
        actor, critic = model.actor, model.critic
        extractors = (actor.features_extractor, critic.features_extractor)
        return (
            SquashedActor.supports(actor)
            and all(is_mlp(network) for network in critic.q_networks)
            and not any(list(each.parameters()) for each in extractors)
        )

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do a number of updates with batches of the replay buffer, and log what SB3 logs."""
        model = self._model
        optimizers = [model.actor.optimizer, model.critic.optimizer]
        if model.ent_coef_optimizer is not None:
            optimizers.append(model.ent_coef_optimizer)
        model._update_learning_rate(optimizers)
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for step in range(gradient_steps):
            batch = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
            self._update(batch, logged, with_loss=step % _LOSS_EVERY == 0)
            if step % model.target_update_interval == 0:
                torch._foreach_lerp_(self._following, self._followed, model.tau)
        model._n_updates += gradient_steps
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _update(self, batch: Any, logged: dict[str, list[float]], *, with_loss: bool) -> None:
        actor = self._model.actor
        features, next_features = (
            actor.extract_features(each, actor.features_extractor)
            for each in (batch.observations, batch.next_observations)
        )
        if self._model.use_sde:
            actor.reset_noise()
        sample = self._actor.sample(features)
        coefficient = self._update_coefficient(sample, logged)
        target = self._compute_target(batch, next_features, coefficient)
        outputs = self._update_critics(torch.cat([features, batch.actions], 1), target)
        if with_loss:
            logged["critic_loss"].append(sum(self._compute_loss(output, target) for output in outputs))
        logged["actor_loss"].append(self._update_actor(features, sample, coefficient))

    def _update_coefficient(self, sample: Sample, logged: dict[str, list[float]]) -> float:
        """Return the entropy coefficient, and learn it if it is to be learnt."""
        model = self._model
        if model.ent_coef_optimizer is None:
            coefficient: float = model.ent_coef_tensor.item()
        else:
            coefficient = model.log_ent_coef.exp().item()
            missing = -(sample.log_prob.mean() + model.target_entropy)
            logged["ent_coef_loss"].append((model.log_ent_coef * missing).item())
            model.log_ent_coef.grad = missing.view_as(model.log_ent_coef)
            model.ent_coef_optimizer.step()
        logged["ent_coef"].append(coefficient)
        return coefficient

    def _compute_target(self, batch: Any, next_features: Tensor, coefficient: float) -> Tensor:
        """Return what the critics are to expect, shape (batch, estimates)."""
        sample = self._actor.sample(next_features)
        inputs = torch.cat([next_features, sample.action], 1)
        outputs = self._side_by_side.run([functools.partial(target.run, inputs) for target in self._targets])
        estimates = self._choose_estimates([values[-1] for values in outputs])
        discount = self._model.gamma if batch.discounts is None else batch.discounts
        result: Tensor = batch.rewards + (1 - batch.dones) * discount * (estimates - coefficient * sample.log_prob)
        return result

    def _update_critics(self, inputs: Tensor, target: Tensor) -> list[Tensor]:
        """Return the critics' outputs before the update."""
        outputs = self._side_by_side.run(
            [functools.partial(self._compute_critic_gradients, critic, inputs, target) for critic in self._critics]
        )
        self._model.critic.optimizer.step()
        return outputs

    def _compute_critic_gradients(self, critic: Mlp, inputs: Tensor, target: Tensor) -> Tensor:
        """Set the gradients of a critic's weights; return its output."""
        values = critic.run(inputs)
        critic.backpropagate(values, self._differentiate_loss(values[-1], target))
        return values[-1]

    def _update_actor(self, features: Tensor, sample: Sample, coefficient: float) -> float:
        """Return the actor's loss."""
        inputs = torch.cat([features, sample.action], 1)
        passes = self._side_by_side.run([functools.partial(critic.run, inputs) for critic in self._critics])
        value, to_outputs = self._judge([values[-1] for values in passes])
        to_inputs = self._side_by_side.run(
            [
                functools.partial(critic.input_gradient, values, to_output / -len(value))
                for critic, values, to_output in zip(self._critics, passes, to_outputs, strict=True)
            ]
        )
        to_action = torch.stack(to_inputs).sum(0)[:, features.shape[1] :]
        self._actor.backpropagate(sample, to_action, coefficient / len(value))
        self._model.actor.optimizer.step()
        return (coefficient * sample.log_prob - value).mean().item()

    def _choose_estimates(self, outputs: list[Tensor]) -> Tensor:
        """Return the estimates of target critics that count, shape (batch, estimates)."""
        return torch.cat(outputs, 1).amin(1, keepdim=True)

    def _compute_loss(self, output: Tensor, target: Tensor) -> float:
        """Return a critic's share of the loss."""
        return 0.5 * (output - target).square().mean().item()

    def _differentiate_loss(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the gradient of a critic's share of the loss with respect to its output."""
        return (output - target) / len(output)

    def _judge(self, outputs: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Return the value of actions by the critics' outputs, shape (batch, 1), and its gradient for each output."""
        value, lowest = torch.cat(outputs, 1).min(1, keepdim=True)
        return value, [(lowest == index).float() for index in range(len(outputs))]
