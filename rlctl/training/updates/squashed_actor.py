"""The actor of SAC and TQC: samples actions, and computes gradients of its weights without autograd.

The name of a gradient is its variable: `to_action` is the gradient of the loss with respect to the action.
"""

import dataclasses
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution, StateDependentNoiseDistribution

from rlctl.training.updates.mlp import (
    LOG_SQRT_TAU,
    Floats,
    MlpStack,
    allocate_gradient,
    is_mlp,
    join_outputs,
    share_joined,
)

_LOG_STD_MIN, _LOG_STD_MAX = -20.0, 2.0  # SB3's limits, without gSDE


@dataclasses.dataclass(frozen=True)
class Sample:
    """Sampled actions of a batch, and the values for their gradients; shape (batch, actions) each."""

    values: list[Floats]  # the outputs of the actor's layers
    noise: Floats  # added to the mean before tanh
    std: Floats
    action: Floats
    log_prob: Floats  # shape (batch, 1)


class SquashedGaussianActor:
    """A normal distribution, with or without gSDE, of actions that tanh squashes."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor
        self._epsilon = float(actor.action_dist.epsilon)
        self._mean_limit = float(actor.clip_mean) if actor.use_sde and actor.clip_mean > 0 else None
        modules = _list_modules(actor)
        if actor.use_sde:
            self._network = MlpStack([modules])
            self._log_std_gradient = allocate_gradient(actor.log_std)
        else:
            heads = [modules[-1], actor.log_std]
            joined = join_outputs(heads)
            self._network = MlpStack([[*modules[:-1], joined]])
            share_joined(heads, joined)
        self._count = modules[-1].out_features

    @staticmethod
    def supports(actor: Any) -> bool:
        """Return whether an actor of SB3 can be used so."""
        distribution = actor.action_dist
        if isinstance(distribution, StateDependentNoiseDistribution):
            plain = distribution.full_std and not distribution.use_expln
        else:
            plain = type(distribution) is SquashedDiagGaussianDistribution
        return plain and len(actor.latent_pi) > 0 and is_mlp(_list_modules(actor))

    def sample(self, features: Floats, use: str) -> Sample:
        """Draw actions for features, shape (batch, features); the next with the same `use` overwrites its `values`."""
        values = self._network.run(features[None], use)
        latent, mean = values[-2][0], values[-1][0, :, : self._count]
        if self._actor.use_sde:
            if self._mean_limit is not None:
                mean = mean.clip(-self._mean_limit, self._mean_limit)
            noise = latent @ self._actor.action_dist.exploration_mat.numpy()
            std = np.sqrt(np.square(latent) @ np.exp(2 * self._actor.log_std.numpy()) + self._epsilon)
            log_std, z = np.log(std), noise / std
        else:
            log_std = values[-1][0, :, self._count :].clip(_LOG_STD_MIN, _LOG_STD_MAX)
            z = np.empty_like(log_std)
            torch.from_numpy(z).normal_()  # torch's generator, as in SB3
            std = np.exp(log_std)
            noise = std * z
        action = np.tanh(mean + noise)
        squashing = np.log(1 - np.square(action) + self._epsilon)
        log_prob = (np.square(z) * -0.5 - log_std - squashing - LOG_SQRT_TAU).sum(1, keepdims=True)
        return Sample(values, noise, std, action, log_prob)

    def backpropagate(self, sample: Sample, to_action: Floats, to_log_prob: float) -> None:
        """Set the gradients of the weights from those of sampled actions and of their log-probabilities."""
        slope = 1 - np.square(sample.action)
        to_mean = to_action * slope + sample.action * slope / (slope + self._epsilon) * (2 * to_log_prob)
        outputs = sample.values[-1][0]
        if self._actor.use_sde:
            to_latent = self._backpropagate_gsde(sample.values[-2][0], sample, to_mean, to_log_prob)
            if self._mean_limit is not None:
                to_mean = to_mean * (np.abs(outputs) < self._mean_limit)
            self._network.backpropagate(sample.values, to_mean[None], latent=to_latent[None])
            return
        log_std = outputs[:, self._count :]
        within = (log_std >= _LOG_STD_MIN) & (log_std <= _LOG_STD_MAX)
        to_log_std = (to_mean * sample.noise - np.float32(to_log_prob)) * within
        self._network.backpropagate(sample.values, np.concatenate([to_mean, to_log_std], 1)[None])

    def _backpropagate_gsde(self, latent: Floats, sample: Sample, to_mean: Floats, to_log_prob: float) -> Floats:
        """Set the gradient of `log_std`, and return that of the latent values."""
        # noise = latent @ matrix, where matrix = exp(log_std) * normal numbers, and
        # std^2 = latent^2 @ exp(2 log_std) + epsilon.
        matrix, variances = self._actor.action_dist.exploration_mat.numpy(), np.exp(2 * self._actor.log_std.numpy())
        precision = np.reciprocal(np.square(sample.std))
        to_noise = to_mean - sample.noise * precision * to_log_prob
        to_variance = (np.square(sample.noise) * precision - 1) * precision * (0.5 * to_log_prob)
        np.multiply(latent.T @ to_noise, matrix, out=self._log_std_gradient)
        self._log_std_gradient += (np.square(latent).T @ to_variance) * variances * 2
        gradient: Floats = to_noise @ matrix.T + latent * (to_variance @ variances.T) * 2
        return gradient


def _list_modules(actor: Any) -> list[Any]:
    mean = actor.mu[0] if isinstance(actor.mu, torch.nn.Sequential) else actor.mu  # gSDE clips it
    return [*actor.latent_pi, mean]
