"""Updates of SAC and TQC without autograd; equal to SB3's and sb3-contrib's `train` except for rounding.

T. Haarnoja et al., Soft Actor-Critic Algorithms and Applications, 2018, https://arxiv.org/abs/1812.05905.
A. Kuznetsov et al., Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
Critics, 2020, https://arxiv.org/abs/2005.04269.
"""

import collections
import functools
from typing import Any, ClassVar

import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import SAC

from rlctl.training.updates.batches import Batch, sample_batches
from rlctl.training.updates.mlp import Floats, SideBySide, is_mlp
from rlctl.training.updates.squashed_actor import Sample, SquashedGaussianActor

_LOSS_EVERY = 8  # every so many updates the losses are computed, for the log only


class SacUpdate:
    """Updates a SAC model whose networks are multi-layer perceptrons on the CPU."""

    algorithm: ClassVar[Any] = SAC

    def __init__(self, model: Any) -> None:
        self._model = model
        self._policy_delay = getattr(model, "policy_delay", 1)  # SB3's own models have none
        self._actor = SquashedGaussianActor(model.actor)
        self._side_by_side = SideBySide(list(model.critic.q_networks), model.batch_size)
        self._critics = self._side_by_side.make_stacks(model.critic.q_networks)
        self._targets = self._side_by_side.make_stacks(model.critic_target.q_networks)
        self._followed = [values for critic in self._critics for values in critic.parameters]
        self._following = [values for target in self._targets for values in target.parameters]

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        if type(model) is not cls.algorithm:
            return False
        networks = model.critic.q_networks
        return SquashedGaussianActor.supports(model.actor) and all(is_mlp(network) for network in networks)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model = self._model
        optimizers = [model.actor.optimizer, model.critic.optimizer]
        if model.ent_coef_optimizer is not None:
            optimizers.append(model.ent_coef_optimizer)
        model._update_learning_rate(optimizers)
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for step, batch in enumerate(sample_batches(model, model.actor, gradient_steps, batch_size)):
            learns_actor = (model._n_updates + step) % self._policy_delay == 0
            self._update(batch, logged, learns_actor=learns_actor, with_loss=step % _LOSS_EVERY == 0)
            if step % model.target_update_interval == 0:
                torch._foreach_lerp_(self._following, self._followed, model.tau)
        model._n_updates += gradient_steps
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _update(self, batch: Batch, logged: dict[str, list[float]], *, learns_actor: bool, with_loss: bool) -> None:
        model = self._model
        if model.use_sde:
            model.actor.reset_noise()
        tensor = model.ent_coef_tensor if model.ent_coef_optimizer is None else model.log_ent_coef.exp()
        coefficient, sample = float(tensor.item()), None
        if learns_actor:
            sample = self._actor.sample(batch.features, "learning")
            self._update_coefficient(sample, logged)
            logged["ent_coef"].append(coefficient)
        target = self._compute_target(batch, coefficient)
        outputs = self._update_critics(np.concatenate([batch.features, batch.actions], 1), target)
        if with_loss:
            logged["critic_loss"].append(self._compute_loss(outputs, target))
        if sample is not None:
            logged["actor_loss"].append(self._update_actor(batch.features, sample, coefficient))

    def _update_coefficient(self, sample: Sample, logged: dict[str, list[float]]) -> None:
        model = self._model
        if model.ent_coef_optimizer is None:
            return
        missing = -(float(sample.log_prob.mean()) + float(model.target_entropy))
        logged["ent_coef_loss"].append(model.log_ent_coef.item() * missing)
        model.log_ent_coef.grad = torch.full_like(model.log_ent_coef, missing)
        model.ent_coef_optimizer.step()

    def _compute_target(self, batch: Batch, coefficient: float) -> Floats:
        """Return the critics' targets, shape (batch, estimates)."""
        sample = self._actor.sample(batch.next_features, "next")
        inputs = np.concatenate([batch.next_features, sample.action], 1)[None]
        passes = self._side_by_side.run([functools.partial(stack.run, inputs, "target") for stack in self._targets])
        estimates = self._choose_estimates(np.concatenate([values[-1] for values in passes]))
        target: Floats = batch.rewards + batch.discounts * (estimates - coefficient * sample.log_prob)
        return target

    def _update_critics(self, inputs: Floats, target: Floats) -> Floats:
        """Return the critics' outputs before the update, shape (critics, batch, outputs)."""

        def learn(index: int) -> Floats:
            critics = self._critics[index]
            values = critics.run(inputs[None], "learning")
            critics.backpropagate(values, self._differentiate_loss(values[-1], target))
            return values[-1]

        outputs = self._side_by_side.run([functools.partial(learn, index) for index in range(len(self._critics))])
        self._model.critic.optimizer.step()
        return np.concatenate(outputs)

    def _update_actor(self, features: Floats, sample: Sample, coefficient: float) -> float:
        """Return the actor's loss."""
        inputs = np.concatenate([features, sample.action], 1)[None]
        passes = self._side_by_side.run([functools.partial(critics.run, inputs, "actor") for critics in self._critics])
        value, to_outputs = self._value(np.concatenate([values[-1] for values in passes]))
        to_outputs /= -len(value)
        calls, first = [], 0
        for critics, values in zip(self._critics, passes, strict=True):
            part = to_outputs[first : first + critics.count]
            calls.append(functools.partial(critics.input_gradient, values, part, features.shape[1]))
            first += critics.count
        to_action = np.concatenate(self._side_by_side.run(calls)).sum(0)
        self._actor.backpropagate(sample, to_action, coefficient / len(value))
        self._model.actor.optimizer.step()
        return float((coefficient * sample.log_prob - value).mean())

    def _choose_estimates(self, outputs: Floats) -> Floats:
        """Return the target critics' estimates that form the target, shape (batch, estimates)."""
        estimates: Floats = outputs.min(0)
        return estimates

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        return 0.5 * float(np.square(outputs - target).mean((1, 2)).sum())

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        """Return the gradient of the critics' loss with respect to their outputs, shape (critics, batch, outputs)."""
        return (outputs - target) / np.float32(outputs.shape[1])

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        """Return the value from the critics' outputs, shape (batch, 1), and its gradient with respect to them."""
        lowest = outputs.argmin(0)
        to_outputs = (np.arange(len(outputs))[:, None, None] == lowest).astype(np.float32)
        return outputs.min(0), to_outputs


class TqcUpdate(SacUpdate):
    """SAC's update with critics that estimate quantiles of the return; the highest are dropped from targets."""

    algorithm: ClassVar[Any] = TQC

    def _choose_estimates(self, outputs: Floats) -> Floats:
        dropped = self._model.top_quantiles_to_drop_per_net * len(outputs)
        estimates = np.sort(np.concatenate(list(outputs), 1), axis=1)
        return estimates[:, : estimates.shape[1] - dropped]

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        """Compare each quantile with each estimate by the quantile Huber loss."""
        errors = target[:, None, :] - outputs[..., None]
        sizes = np.abs(errors)
        sizes = np.where(sizes <= 1, 0.5 * np.square(sizes), sizes - 0.5)
        shares = _quantile_shares(outputs)[:, None]
        return float((sizes * np.where(errors < 0, 1 - shares, shares)).mean())

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        # The derivative of the Huber loss is the error, clipped to [-1, 1]. Its weight is the
        # quantile's share if positive, else 1 - share; both sums follow from the slopes' sum and absolute sum.
        slopes = target[:, None, :] - outputs[..., None]
        np.clip(slopes, -1, 1, out=slopes)
        ones = np.ones(target.shape[1], np.float32)  # short sums are faster as products
        total = slopes @ ones
        size = np.abs(slopes, out=slopes) @ ones
        count = np.float32(-2 * slopes[0].size * len(self._model.critic.q_networks))
        gradient: Floats = (total + (2 * _quantile_shares(outputs) - 1) * size) / count
        return gradient

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        count = outputs.shape[0] * outputs.shape[2]
        value: Floats = outputs.mean((0, 2))[:, None]
        return value, np.full_like(outputs, 1 / count)


def _quantile_shares(outputs: Floats) -> Floats:
    """Return the share of returns below each quantile, shape (quantiles,)."""
    count = outputs.shape[-1]
    return (np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count)
