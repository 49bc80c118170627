"""The actor of SAC and TQC: actions that it draws, and gradients of its weights, without autograd.

What a gradient is of stands in its name: `to_action` is the gradient of the loss with respect to the action.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution, StateDependentNoiseDistribution
from torch import Tensor

from rlctl.training.updates.mlp import LOG_SQRT_TAU, Mlp, is_mlp, share_gradients

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
    """A normal distribution, with or without gSDE, of actions that tanh squashes."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor
        self._network = Mlp(_actor_modules(actor))
        self._epsilon = float(actor.action_dist.epsilon)
        self._mean_limit = float(actor.clip_mean) if actor.use_sde and actor.clip_mean > 0 else None
        share_gradients(actor.parameters())

    @staticmethod
    def supports(actor: Any) -> bool:
        """Return whether an actor of SB3 can be used so."""
        distribution = actor.action_dist
        if isinstance(distribution, StateDependentNoiseDistribution):
            plain = distribution.full_std and not distribution.use_expln
        else:
            plain = type(distribution) is SquashedDiagGaussianDistribution
        return plain and len(actor.latent_pi) > 0 and is_mlp(_actor_modules(actor))

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


def _actor_modules(actor: Any) -> list[torch.nn.Module]:
    mean = actor.mu[0] if isinstance(actor.mu, torch.nn.Sequential) else actor.mu  # gSDE clips it
    return [*actor.latent_pi, mean]
