"""PPO's updates without autograd; equal to SB3's `PPO.train` except for rounding.

J. Schulman et al., Proximal Policy Optimization Algorithms, 2017, https://arxiv.org/abs/1707.06347.
"""

import collections
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution, StateDependentNoiseDistribution
from stable_baselines3.common.utils import explained_variance

from rlctl.environments.dict_spaces import map_parts
from rlctl.training.privileged import has_privileged_critic
from rlctl.training.updates.adam import VectorAdam
from rlctl.training.updates.blocks import Blocks, count_blocks
from rlctl.training.updates.mlp import bind, bind_networks, is_mlp, list_sizes, uses_tanh
from rlctl.training.updates.perceptrons import clip_norm, split_vector
from rlctl.training.updates.ppo_gradients import DIFFERENTIATE, EVALUATE, LOSSES, PpoGradients, PpoSettings


class PpoUpdate:
    """Updates a PPO model, on the CPU, with multi-layer perceptrons and normally distributed actions."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._policy = model.policy
        actor, critic = _actor_modules(self._policy), _critic_modules(self._policy)
        settings = PpoSettings(
            rows=model.n_steps * model.n_envs,
            actor=list_sizes(actor),
            critic=list_sizes(critic),
            actor_uses_tanh=uses_tanh(actor),
            critic_uses_tanh=uses_tanh(critic),
            log_std=tuple(self._policy.log_std.shape),
            sde_epsilon=float(self._policy.action_dist.epsilon) if self._policy.use_sde else None,
            ent_coef=model.ent_coef,
            vf_coef=model.vf_coef,
            mirror=getattr(model, "mirror", None),
            mirror_images=getattr(model, "mirror_images", True),
            mirror_loss=getattr(model, "mirror_loss", 0.0),
        )
        self._mirror_loss = settings.mirror_loss
        shapes = settings.list_shapes()
        self._weights = sum(math.prod(shape) for shape in shapes)
        largest = min(model.batch_size, settings.rows)
        blocks = self._count_blocks(largest)
        self._blocks = Blocks(PpoGradients, settings, 2 * blocks if blocks > 1 else 1)
        self._arrays = self._blocks.arrays
        self.close = self._blocks.close
        parameters, gradients = (split_vector(self._arrays[name], shapes) for name in ("parameters", "gradient"))
        layers = 2 * len(settings.actor) - 2
        bind_networks([actor], parameters[:layers], gradients[:layers])
        bind_networks([critic], parameters[layers:-1], gradients[layers:-1])
        bind(self._policy.log_std, parameters[-1], gradients[-1])
        self._adam = VectorAdam(self._policy.optimizer, self._arrays["parameters"], self._arrays["gradient"])

    @staticmethod
    def supports(model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        policy = model.policy
        if type(model) is not PPO or not (policy.share_features_extractor or has_privileged_critic(policy)):
            return False
        distribution = policy.action_dist
        if isinstance(distribution, StateDependentNoiseDistribution):
            changed = distribution.use_expln or distribution.learn_features or distribution.bijector
            plain = distribution.full_std and not changed
        else:
            plain = type(distribution) is DiagGaussianDistribution
        return bool(plain) and is_mlp(_actor_modules(policy)) and is_mlp(_critic_modules(policy))

    @torch.no_grad()
    def evaluate(self, observations: Any, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the values of a rollout's observations and the log-probabilities of its actions, shape (rows,)."""
        rows = len(actions)
        count = self._count_blocks(rows)
        self._arrays["features"][:] = self._extract(observations)
        self._arrays["actions"][:] = actions
        self._arrays["minibatch"][:] = 0, rows, count
        self._blocks.run(EVALUATE, 2 * count)
        return self._arrays["values"].copy(), self._arrays["log_probs"].copy()

    def _extract(self, observations: Any) -> NDArray[Any]:
        """Return the features: those of the critic, if it sees more than the actor, whose own come first."""
        features = self._policy.extract_features(observations)
        wide: NDArray[Any] = (features[1] if has_privileged_critic(self._policy) else features).numpy()
        return wide

    @torch.no_grad()
    def train(self) -> None:
        """Update the policy with the rollout in the model's buffer; log what SB3 logs."""
        model, policy = self._model, self._policy
        model._update_learning_rate(policy.optimizer)
        clip_range = model.clip_range(model._current_progress_remaining)
        clip_range_vf = model.clip_range_vf and model.clip_range_vf(model._current_progress_remaining)
        self._arrays["clip_ranges"][:] = clip_range, np.inf if clip_range_vf is None else clip_range_vf
        advantages = self._read_buffer()
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for _ in range(model.n_epochs):
            logged["approx_kl"] = []
            # SB3's generator: checkpoints hold its state.
            order = np.random.permutation(len(advantages))  # noqa: NPY002
            self._arrays["order"][:], self._arrays["advantages"][:] = order, advantages[order]
            starts = range(0, len(order), model.batch_size)
            sizes = (min(model.batch_size, len(order) - first) for first in starts)
            minibatches = zip(starts, sizes, strict=True)
            finished = all(self._learn_minibatch(first, size, logged) for first, size in minibatches)
            model._n_updates += 1
            if not finished:
                break
        self._log(logged, clip_range, clip_range_vf)

    def _read_buffer(self) -> NDArray[Any]:
        """Write the rollout into the shared arrays, shape (steps * environments, ...) each; return its advantages."""
        buffer = self._model.rollout_buffer
        observations = map_parts(lambda rows: torch.from_numpy(buffer.swap_and_flatten(rows)), buffer.observations)
        self._arrays["features"][:] = self._extract(observations)
        self._arrays["actions"][:] = buffer.swap_and_flatten(buffer.actions)  # the buffer has the type of the space
        for name in ("values", "log_probs", "returns"):
            self._arrays[name][:] = buffer.swap_and_flatten(getattr(buffer, name)).ravel()
        advantages: NDArray[Any] = buffer.swap_and_flatten(buffer.advantages).ravel()
        return advantages

    def _learn_minibatch(self, first: int, size: int, logged: dict[str, list[float]]) -> bool:
        """Learn from a minibatch; return False without an update if the policy has moved beyond `target_kl`."""
        model, count = self._model, self._count_blocks(size)
        if model.normalize_advantage and size > 1:
            advantages = self._arrays["advantages"][first : first + size]
            advantages -= advantages.mean()
            advantages /= advantages.std(ddof=1) + np.float32(1e-8)
        self._arrays["minibatch"][:] = first, size, count
        self._blocks.run(DIFFERENTIATE, 2 * count)
        losses = dict(zip(LOSSES, (self._arrays["losses"][:count].sum(0) / size).tolist(), strict=True))
        if not self._mirror_loss:
            del losses["mirror_loss"]
        for name, loss in losses.items():
            logged[name].append(loss)
        entropy_loss = model.ent_coef * losses["entropy_loss"]
        mirror_loss = self._mirror_loss * losses.get("mirror_loss", 0.0)
        loss = losses["policy_gradient_loss"] + entropy_loss + model.vf_coef * losses["value_loss"] + mirror_loss
        logged["loss"] = [loss]
        if model.target_kl is not None and losses["approx_kl"] > 1.5 * model.target_kl:
            return False
        gradient = self._blocks.add_gradients(count, slice(0, len(self._arrays["gradient"])))
        clip_norm(gradient, model.max_grad_norm)
        self._adam.step()
        return True

    def _count_blocks(self, size: int) -> int:
        return count_blocks(size, self._weights)

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


def _actor_modules(policy: Any) -> list[torch.nn.Module]:
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def _critic_modules(policy: Any) -> list[torch.nn.Module]:
    return [*policy.mlp_extractor.value_net, policy.value_net]
