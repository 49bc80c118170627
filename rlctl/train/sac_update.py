"""SAC's updates with gradients computed without autograd: what SB3's `SAC.train` computes, but for rounding.

T. Haarnoja et al., Soft Actor-Critic Algorithms and Applications, 2018, https://arxiv.org/abs/1812.05905. Below, what a
gradient is of stands in its name: `to_action` is the gradient of the loss with respect to the action.
"""

from __future__ import annotations

import collections
import dataclasses
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution, StateDependentNoiseDistribution
from torch import Tensor

from rlctl.train.mlp import LOG_SQRT_TAU, Mlp, is_mlp, share_gradients

_LOG_STD_MIN, _LOG_STD_MAX = -20.0, 2.0  # SB3's limits, without gSDE


@dataclasses.dataclass(frozen=True)
class Sample:
    """Actions of a batch that the actor drew, and what their gradients are computed from; (batch, actions) each."""

    values: list[Tensor]
    """What the layers of the actor made of the observations."""
    noise: Tensor
    """What was added to the mean before the actions were squashed."""
    std: Tensor
    action: Tensor
    log_prob: Tensor
    """Shape (batch, 1)."""


class SquashedActor:
    """SB3's actor of SAC: a normal distribution, with or without gSDE, of actions that tanh squashes."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor
        self._network = Mlp(_actor_modules(actor))
        self._epsilon = float(actor.action_dist.epsilon)
        self._mean_limit = float(actor.clip_mean) if actor.use_sde and actor.clip_mean > 0 else None
        share_gradients(actor.parameters())

    def sample(self, features: Tensor) -> Sample:
        """Draw actions; with gSDE by the matrix that was drawn last."""
        values = self._network.run(features)
        latent, mean = values[-2:]
        if self._actor.use_sde:
            if self._mean_limit is not None:
                mean = mean.clamp(-self._mean_limit, self._mean_limit)
            noise = latent @ self._actor.action_dist.exploration_mat
            std = (latent.square() @ torch.exp(2 * self._actor.log_std) + self._epsilon).sqrt()
            log_std, z = std.log(), noise / std
        else:
            log_std = self._actor.log_std(latent).clamp(_LOG_STD_MIN, _LOG_STD_MAX)
            std, z = log_std.exp(), torch.randn_like(mean)
            noise = std * z
        action = torch.tanh(mean + noise)
        squashing = (1 - action.square() + self._epsilon).log()
        log_prob = (z.square() * -0.5 - log_std - squashing - LOG_SQRT_TAU).sum(1, keepdim=True)
        return Sample(values, noise, std, action, log_prob)

    def backpropagate(self, sample: Sample, to_action: Tensor, to_log_prob: float) -> None:
        """Set the gradients of the weights from those of drawn actions and of each of their log-probabilities."""
        slope = 1 - sample.action.square()
        to_mean = to_action * slope + sample.action * slope / (slope + self._epsilon) * (2 * to_log_prob)
        latent, mean = sample.values[-2:]
        if self._actor.use_sde:
            to_latent = self._backpropagate_gsde(latent, sample, to_mean, to_log_prob)
            if self._mean_limit is not None:
                to_mean = to_mean * (mean.abs() < self._mean_limit)
        else:
            layer = self._actor.log_std
            log_std = layer(latent)
            within = (log_std >= _LOG_STD_MIN) & (log_std <= _LOG_STD_MAX)
            to_log_std = (to_mean * sample.noise - to_log_prob) * within
            torch.mm(to_log_std.t(), latent, out=layer.weight.grad)
            torch.sum(to_log_std, 0, out=layer.bias.grad)
            to_latent = to_log_std @ layer.weight
        self._network.backpropagate(sample.values, to_mean, latent=to_latent)

    def _backpropagate_gsde(self, latent: Tensor, sample: Sample, to_mean: Tensor, to_log_prob: float) -> Tensor:
        """Set the gradient of `log_std`, and return that of the latent values."""
        # noise = latent @ matrix, where matrix = exp(log_std) * normal numbers, and
        # std^2 = latent^2 @ exp(2 log_std) + epsilon.
        matrix, variances = self._actor.action_dist.exploration_mat, torch.exp(2 * self._actor.log_std)
        precision = sample.std.square().reciprocal()
        to_noise = to_mean - sample.noise * precision * to_log_prob
        to_variance = (sample.noise.square() * precision - 1) * precision * (0.5 * to_log_prob)
        torch.mul(latent.t() @ to_noise, matrix, out=self._actor.log_std.grad)
        self._actor.log_std.grad += (latent.square().t() @ to_variance) * variances * 2
        gradient: Tensor = to_noise @ matrix.t() + latent * (to_variance @ variances.t()) * 2
        return gradient


class SacUpdate:
    """Updates a SAC model whose networks are multi-layer perceptrons."""

    def __init__(self, model: SAC) -> None:
        self._model: Any = model
        self._actor = SquashedActor(model.actor)
        self._critics, self._targets = (
            [Mlp(modules) for modules in _critic_modules(critic)] for critic in (model.critic, model.critic_target)
        )
        share_gradients(model.critic.parameters())
        self._followed = [each.data for each in model.critic.parameters()]
        self._following = [each.data for each in model.critic_target.parameters()]

    @staticmethod
    def supports(model: Any) -> bool:
        """Return whether a model can be updated so; otherwise SB3 does it."""
        if type(model) is not SAC:
            return False
        actor, critic = model.actor, model.critic
        distribution = actor.action_dist
        if isinstance(distribution, StateDependentNoiseDistribution):
            plain = distribution.full_std and not distribution.use_expln
        else:
            plain = type(distribution) is SquashedDiagGaussianDistribution
        networks = [_actor_modules(actor), *_critic_modules(critic)]
        extractors = (actor.features_extractor, critic.features_extractor)
        return (
            plain
            and len(actor.latent_pi) > 0
            and all(map(is_mlp, networks))
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
            self._update(model.replay_buffer.sample(batch_size, env=model._vec_normalize_env), logged)
            if step % model.target_update_interval == 0:
                torch._foreach_lerp_(self._following, self._followed, model.tau)
        model._n_updates += gradient_steps
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _update(self, batch: Any, logged: dict[str, list[float]]) -> None:
        model, actor = self._model, self._model.actor
        features, next_features = (
            actor.extract_features(each, actor.features_extractor)
            for each in (batch.observations, batch.next_observations)
        )
        if model.use_sde:
            actor.reset_noise()
        sample = self._actor.sample(features)
        coefficient = self._update_coefficient(sample, logged)

        then = self._actor.sample(next_features)
        next_value = self._run(self._targets, next_features, then.action)[1] - coefficient * then.log_prob
        discount = model.gamma if batch.discounts is None else batch.discounts
        target = batch.rewards + (1 - batch.dones) * discount * next_value
        inputs = torch.cat([features, batch.actions], 1)
        loss = 0.0
        for critic in self._critics:
            values = critic.run(inputs)
            error = values[-1] - target
            loss += 0.5 * error.square().mean().item()
            critic.backpropagate(values, error / len(error))
        model.critic.optimizer.step()
        logged["critic_loss"].append(loss)

        passes, value, lowest = self._run(self._critics, features, sample.action)
        logged["actor_loss"].append((coefficient * sample.log_prob - value).mean().item())
        to_action = torch.zeros_like(sample.action)
        for index, (critic, values) in enumerate(zip(self._critics, passes, strict=True)):
            to_value = (lowest == index) / -len(value)
            to_action += critic.input_gradient(values, to_value)[:, features.shape[1] :]
        self._actor.backpropagate(sample, to_action, coefficient / len(value))
        actor.optimizer.step()

    @staticmethod
    def _run(critics: list[Mlp], features: Tensor, action: Tensor) -> tuple[list[list[Tensor]], Tensor, Tensor]:
        """Return what critics make of actions, the lowest value of each, and which critic's it is; (batch, 1) both."""
        inputs = torch.cat([features, action], 1)
        passes = [critic.run(inputs) for critic in critics]
        return passes, *torch.cat([values[-1] for values in passes], 1).min(1, keepdim=True)

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


def _actor_modules(actor: Any) -> list[torch.nn.Module]:
    mean = actor.mu[0] if isinstance(actor.mu, torch.nn.Sequential) else actor.mu  # gSDE clips it
    return [*actor.latent_pi, mean]


def _critic_modules(critic: Any) -> list[list[torch.nn.Module]]:
    return [list(network) for network in critic.q_networks]
