"""PPO's updates without autograd; equal to SB3's `PPO.train` except for rounding.

J. Schulman et al., Proximal Policy Optimization Algorithms, 2017, https://arxiv.org/abs/1707.06347. The name of a
gradient is its variable: `to_mean` is the gradient of the loss with respect to the mean.
"""

import collections
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution, StateDependentNoiseDistribution
from stable_baselines3.common.utils import explained_variance

from rlctl.environments.dict_spaces import map_parts
from rlctl.training.updates import adam
from rlctl.training.updates.mlp import LOG_SQRT_TAU, Floats, MlpStack, SideBySide, clip_norm, is_mlp, share_gradients

_FIELDS = ("actions", "values", "log_probs", "advantages", "returns")


class PpoUpdate:
    """Updates a PPO model, on the CPU, with multi-layer perceptrons and normally distributed actions."""

    def __init__(self, model: PPO) -> None:
        policy: Any = model.policy
        self._model: Any = model
        self._policy = policy
        networks = (_actor_modules(policy), _critic_modules(policy))
        self._actor, self._critic = (MlpStack([network]) for network in networks)
        self._log_std_gradient = share_gradients([policy.log_std])[0]
        self._gradients = [*self._actor.gradients, *self._critic.gradients, self._log_std_gradient]
        self._side_by_side = SideBySide(networks, model.batch_size)

    @staticmethod
    def supports(model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        policy = model.policy
        if type(model) is not PPO or not policy.share_features_extractor:
            return False
        distribution = policy.action_dist
        if isinstance(distribution, StateDependentNoiseDistribution):
            changed = distribution.use_expln or distribution.learn_features or distribution.bijector
            plain = distribution.full_std and not changed
        else:
            plain = type(distribution) is DiagGaussianDistribution
        return bool(plain) and is_mlp(_actor_modules(policy)) and is_mlp(_critic_modules(policy))

    @torch.no_grad()
    def train(self) -> None:
        """Update the policy with the rollout in the model's buffer; log what SB3 logs."""
        model, policy = self._model, self._policy
        model._update_learning_rate(policy.optimizer)
        clip_range = model.clip_range(model._current_progress_remaining)
        clip_range_vf = model.clip_range_vf and model.clip_range_vf(model._current_progress_remaining)
        data = self._read_buffer()
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for _ in range(model.n_epochs):
            logged["approx_kl"] = []
            batches = _shuffle(data, model.batch_size)
            finished = all(self._update(batch, clip_range, clip_range_vf, logged) for batch in batches)
            model._n_updates += 1
            if not finished:
                break
        self._log(logged, clip_range, clip_range_vf)

    def _read_buffer(self) -> dict[str, NDArray[Any]]:
        """Return the rollout, shape (steps * environments, ...) each, with features for observations."""
        buffer = self._model.rollout_buffer
        observations = map_parts(lambda rows: torch.from_numpy(buffer.swap_and_flatten(rows)), buffer.observations)
        data = {name: buffer.swap_and_flatten(getattr(buffer, name)) for name in _FIELDS}
        data |= {name: data[name].ravel() for name in _FIELDS[1:]}
        data["actions"] = data["actions"].astype(np.float32)  # the buffer has the type of the space
        return {"features": self._policy.extract_features(observations).numpy(), **data}

    def _update(
        self,
        batch: dict[str, NDArray[Any]],
        clip_range: float,
        clip_range_vf: float | None,
        logged: dict[str, list[float]],
    ) -> bool:
        """Learn from a minibatch; return False without an update if the policy has moved beyond `target_kl`."""
        model = self._model
        of_actor, of_critic = self._side_by_side.run(
            [
                functools.partial(self._compute_actor_gradients, batch, clip_range),
                functools.partial(self._compute_critic_gradients, batch, clip_range_vf),
            ]
        )
        losses = of_actor | of_critic
        for name, loss in losses.items():
            logged[name].append(loss)
        entropy_loss = model.ent_coef * losses["entropy_loss"]
        logged["loss"] = [losses["policy_gradient_loss"] + entropy_loss + model.vf_coef * losses["value_loss"]]
        if model.target_kl is not None and losses["approx_kl"] > 1.5 * model.target_kl:
            return False
        clip_norm(self._gradients, model.max_grad_norm)
        adam.step(self._policy.optimizer)
        return True

    def _compute_actor_gradients(self, batch: dict[str, NDArray[Any]], clip_range: float) -> dict[str, float]:
        """Set the gradients of the actor's weights; return the losses that SB3 logs."""
        model, size = self._model, len(batch["actions"])
        actor = self._actor.run(batch["features"][None], "learning")
        std = self._compute_std(actor)
        z = (batch["actions"] - actor[-1][0]) / std
        log_std = np.log(std)
        log_prob = (np.square(z) * -0.5 - log_std - LOG_SQRT_TAU).sum(1)
        entropy = (np.broadcast_to(log_std, z.shape) + (0.5 + LOG_SQRT_TAU)).sum(1)

        advantages = batch["advantages"]
        if model.normalize_advantage and size > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-8)
        log_ratio = log_prob - batch["log_probs"]
        ratio = np.exp(log_ratio)
        unclipped, clipped = advantages * ratio, advantages * ratio.clip(1 - clip_range, 1 + clip_range)
        # If the clipped term is smaller, the loss does not depend on the policy.
        to_log_prob = (unclipped * (unclipped <= clipped) / -size)[:, None]
        self._actor.backpropagate(actor, (to_log_prob * z / std)[None])
        self._set_std_gradient(actor, std, to_log_prob * (np.square(z) - 1) - model.ent_coef / size)
        return {
            "policy_gradient_loss": -float(np.minimum(unclipped, clipped).mean()),
            "entropy_loss": -float(entropy.mean()),
            "clip_fraction": float((np.abs(ratio - 1) > clip_range).mean()),
            "approx_kl": float((ratio - 1 - log_ratio).mean()),
        }

    def _compute_critic_gradients(
        self, batch: dict[str, NDArray[Any]], clip_range_vf: float | None
    ) -> dict[str, float]:
        """Set the gradients of the critic's weights; return its loss."""
        critic = self._critic.run(batch["features"][None], "learning")
        values = critic[-1].ravel()
        to_value = values - batch["returns"]
        if clip_range_vf is not None:
            moved = values - batch["values"]
            to_value = batch["values"] + moved.clip(-clip_range_vf, clip_range_vf) - batch["returns"]
        loss = float(np.square(to_value).mean())
        if clip_range_vf is not None:
            to_value = to_value * (np.abs(moved) <= clip_range_vf)
        self._critic.backpropagate(critic, to_value[None, :, None] * (2 * self._model.vf_coef / len(values)))
        return {"value_loss": loss}

    def _compute_std(self, actor: list[Floats]) -> Floats:
        """Return the standard deviation of actions, shape (actions,), with gSDE (batch, actions)."""
        policy = self._policy
        log_std: Floats = policy.log_std.numpy()
        if not policy.use_sde:
            return np.exp(log_std)
        return np.sqrt(np.square(actor[-2][0]) @ np.exp(2 * log_std) + float(policy.action_dist.epsilon))

    def _set_std_gradient(self, actor: list[Floats], std: Floats, to_log_std: Floats) -> None:
        """Set the gradient of `log_std` from that of the logarithm of `_compute_std`, shape (batch, actions)."""
        if not self._policy.use_sde:
            np.sum(to_log_std, 0, out=self._log_std_gradient)
            return
        # std^2 = latent^2 @ exp(2 log_std) + epsilon; no gradient flows into the latent values, as in SB3.
        of_variance = np.square(actor[-2][0]).T @ (to_log_std / np.square(std))
        np.multiply(of_variance, np.exp(2 * self._policy.log_std.numpy()), out=self._log_std_gradient)

    def _log(self, logged: dict[str, list[float]], clip_range: float, clip_range_vf: float | None) -> None:
        model, logger, buffer = self._model, self._model.logger, self._model.rollout_buffer
        for name, values in logged.items():
            logger.record(f"train/{name}", np.mean(values))
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        logger.record("train/explained_variance", explained)
        logger.record("train/std", self._policy.log_std.exp().mean().item())
        logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        logger.record("train/clip_range", clip_range)
        if clip_range_vf is not None:
            logger.record("train/clip_range_vf", clip_range_vf)


def _shuffle(data: dict[str, NDArray[Any]], size: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the minibatches of an epoch in SB3's order."""
    total = len(data["actions"])
    order = np.random.permutation(total)  # noqa: NPY002 (SB3's generator: checkpoints hold its state)
    shuffled = {name: rows[order] for name, rows in data.items()}
    for first in range(0, total, size):
        yield {name: rows[first : first + size] for name, rows in shuffled.items()}


def _actor_modules(policy: Any) -> list[torch.nn.Module]:
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def _critic_modules(policy: Any) -> list[torch.nn.Module]:
    return [*policy.mlp_extractor.value_net, policy.value_net]
