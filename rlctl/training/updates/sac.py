"""Updates of SAC and TQC without autograd; equal to SB3's and sb3-contrib's `train` except for rounding.

T. Haarnoja et al., Soft Actor-Critic Algorithms and Applications, 2018, https://arxiv.org/abs/1812.05905.
"""

import collections
from typing import Any, ClassVar

import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution, StateDependentNoiseDistribution

from rlctl.training.updates import adam
from rlctl.training.updates.adam import VectorAdam
from rlctl.training.updates.batch_norm import is_supported
from rlctl.training.updates.batches import Batch, sample_batches
from rlctl.training.updates.blocks import OFF_POLICY_BLOCKS, Blocks, count_blocks
from rlctl.training.updates.mlp import bind, bind_networks, list_sizes, uses_tanh
from rlctl.training.updates.perceptrons import split_vector
from rlctl.training.updates.sac_gradients import (
    ACTOR,
    ACTOR_LOSS,
    CRITIC_LOSS,
    CRITICS,
    LOG_PROB,
    SacGradients,
    SacSettings,
    TqcGradients,
)

_LOSS_EVERY = 32  # every so many updates the losses are computed, for the log only


class SacUpdate:
    """Updates a SAC model whose networks are multi-layer perceptrons on the CPU."""

    algorithm: ClassVar[Any] = SAC
    gradients: ClassVar[type[SacGradients]] = SacGradients
    first_update: ClassVar[int] = 0  # the number of the first one, of which every `policy_delay`th updates the actor
    has_targets: ClassVar[bool] = True
    noise: ClassVar[tuple[str, ...]] = ("normal", "next_normal")  # in SB3's order of random numbers

    def __init__(self, model: Any) -> None:
        self._model = model
        self._policy_delay = getattr(model, "policy_delay", 1)  # SB3's own models have none
        settings = self._read_settings()
        self._count = self._count_blocks(settings)
        self._blocks = Blocks(self.gradients, settings, self._count)
        self._arrays = self._blocks.arrays
        self.close = self._blocks.close
        self._arrays["numbers"][2] = self._count
        shapes, split = settings.list_shapes(), len(settings.list_critic_shapes())
        of_critics = len(self._arrays["targets"])
        self._parts = {CRITICS: slice(0, of_critics), ACTOR: slice(of_critics, len(self._arrays["gradient"]))}
        vectors = self._arrays["parameters"], self._arrays["gradient"]
        parameters, gradients = (split_vector(vector, shapes) for vector in vectors)
        bind_networks(model.critic.q_networks, parameters[:split], gradients[:split])
        self._bind_actor(parameters[split:], gradients[split:])
        if self.has_targets:
            targets = split_vector(self._arrays["targets"], settings.list_critic_shapes())
            bind_networks(model.critic_target.q_networks, targets)
        optimizers = {CRITICS: model.critic.optimizer, ACTOR: model.actor.optimizer}
        self._adam = {
            phase: VectorAdam(optimizers[phase], *(vector[part] for vector in vectors))
            for phase, part in self._parts.items()
        }

    def _read_settings(self) -> SacSettings:
        model, actor = self._model, self._model.actor
        modules, critic = list_actor_modules(actor), list(model.critic.q_networks[0])
        sizes, actions = list_sizes(modules), modules[-1].out_features
        support = getattr(model.critic, "support", None)
        return SacSettings(
            rows=model.batch_size,
            actions=actions,
            actor=sizes if actor.use_sde else (*sizes[:-1], 2 * actions),  # means, then logarithms of deviations
            actor_uses_tanh=uses_tanh(modules),
            critic=list_sizes(critic),
            critic_uses_tanh=uses_tanh(critic),
            critics=len(model.critic.q_networks),
            log_std=tuple(actor.log_std.shape) if actor.use_sde else None,
            epsilon=float(actor.action_dist.epsilon),
            mean_limit=float(actor.clip_mean) if actor.use_sde and actor.clip_mean > 0 else None,
            dropped=getattr(model, "top_quantiles_to_drop_per_net", 0) * len(model.critic.q_networks),
            atoms=None if support is None else (float(support[0]), float(support[-1])),
        )

    def _count_blocks(self, settings: SacSettings) -> int:
        return count_blocks(settings.rows, settings.count_weights(), most=OFF_POLICY_BLOCKS)

    def _bind_actor(self, parameters: list[Any], gradients: list[Any]) -> None:
        actor, modules = self._model.actor, list_actor_modules(self._model.actor)
        if actor.use_sde:
            bind_networks([modules], parameters[:-1], gradients[:-1])
            bind(actor.log_std, parameters[-1], gradients[-1])
            return
        bind_networks([modules[:-1]], parameters[:-2], gradients[:-2])
        count = modules[-1].out_features
        for linear, rows in ((modules[-1], slice(0, count)), (actor.log_std, slice(count, 2 * count))):
            bind(linear.weight, parameters[-2][0, rows], gradients[-2][0, rows])
            bind(linear.bias, parameters[-1][0, 0, rows], gradients[-1][0, 0, rows])

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        if type(model) is not cls.algorithm:
            return False
        actor, distribution = model.actor, model.actor.action_dist
        if isinstance(distribution, StateDependentNoiseDistribution):
            plain = distribution.full_std and not distribution.use_expln
        else:
            plain = type(distribution) is SquashedDiagGaussianDistribution
        networks = (list_actor_modules(actor), *model.critic.q_networks)
        return plain and len(actor.latent_pi) > 0 and all(is_supported(network) for network in networks)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model = self._model
        optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)
        model._update_learning_rate([optimizer for optimizer in optimizers if optimizer is not None])
        logged: dict[str, list[float]] = collections.defaultdict(list)
        followed = torch.from_numpy(self._arrays["parameters"][self._parts[CRITICS]])
        following = torch.from_numpy(self._arrays["targets"])
        for step, batch in enumerate(sample_batches(model, model.critic, gradient_steps, batch_size)):
            learns_actor = (model._n_updates + step + self.first_update) % self._policy_delay == 0
            self._learn_minibatch(batch, logged, learns_actor=learns_actor, with_loss=step % _LOSS_EVERY == 0)
            if self.has_targets and step % model.target_update_interval == 0:
                following.lerp_(followed, model.tau)
        model._n_updates += gradient_steps
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _learn_minibatch(
        self, batch: Batch, logged: dict[str, list[float]], *, learns_actor: bool, with_loss: bool
    ) -> None:
        coefficient, arrays = self._read_coefficient(), self._arrays
        arrays["numbers"][:2] = coefficient, with_loss
        for name in ("features", "next_features", "actions", "rewards", "discounts"):
            arrays[name][:] = getattr(batch, name)
        self._draw_noise(learns_actor=learns_actor)
        critic_loss = self._differentiate(CRITICS)[CRITIC_LOSS]
        self._step(CRITICS)
        if with_loss:
            logged["critic_loss"].append(critic_loss)
        if learns_actor or self.first_update:
            logged["ent_coef"].append(coefficient)
        if learns_actor:
            sums = self._differentiate(ACTOR)
            self._step(ACTOR)
            self._update_coefficient(sums[LOG_PROB], logged)
            logged["actor_loss"].append(sums[ACTOR_LOSS])

    def _differentiate(self, phase: int) -> list[float]:
        """Set the gradients of the critics or of the actor; return the means over the batch of what is logged."""
        self._blocks.run(phase, self._count)
        self._blocks.add_gradients(self._count, self._parts[phase])
        means: list[float] = (self._arrays["sums"][: self._count].sum(0) / self._model.batch_size).tolist()
        return means

    def _step(self, phase: int) -> None:
        self._adam[phase].step()

    def _draw_noise(self, *, learns_actor: bool) -> None:
        """Draw the numbers that SB3 would draw, from torch's generator."""
        actor = self._model.actor
        if actor.use_sde:
            std = actor.log_std.exp()
            actor.action_dist.exploration_mat = torch.randn(std.shape) * std
            torch.randn(std.shape)  # of the matrices for parallel exploration, which are not used here
            self._arrays["normal"][:] = actor.action_dist.exploration_mat.numpy()
            return
        for name in self.noise:
            if learns_actor or name == "next_normal":
                torch.from_numpy(self._arrays[name]).normal_()

    def _read_coefficient(self) -> float:
        model = self._model
        tensor = model.ent_coef_tensor if model.ent_coef_optimizer is None else model.log_ent_coef.exp()
        return float(tensor.item())

    def _update_coefficient(self, log_prob: float, logged: dict[str, list[float]]) -> None:
        model = self._model
        if model.ent_coef_optimizer is None:
            return
        missing = -(log_prob + float(model.target_entropy))
        logged["ent_coef_loss"].append(model.log_ent_coef.item() * missing)
        model.log_ent_coef.grad = torch.full_like(model.log_ent_coef, missing)
        adam.step(model.ent_coef_optimizer)


class TqcUpdate(SacUpdate):
    """Updates a TQC model whose networks are multi-layer perceptrons on the CPU."""

    algorithm: ClassVar[Any] = TQC
    gradients: ClassVar[type[SacGradients]] = TqcGradients


def list_actor_modules(actor: Any) -> list[Any]:
    """Return the modules of the network that computes the means of the actions."""
    mean = actor.mu[0] if isinstance(actor.mu, torch.nn.Sequential) else actor.mu  # gSDE clips it
    return [*actor.latent_pi, mean]
