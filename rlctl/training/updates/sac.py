"""Updates of SAC without autograd; equal to SB3's `train` except for rounding.

T. Haarnoja et al., Soft Actor-Critic Algorithms and Applications, 2018, https://arxiv.org/abs/1812.05905. The name of a
gradient is its variable: `to_action` is the gradient of the loss with respect to the action.
"""

import collections
import dataclasses
import functools
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution, StateDependentNoiseDistribution

from rlctl.training.updates import adam
from rlctl.training.updates.batch_norm import choose_stack
from rlctl.training.updates.batches import Batch, sample_batches
from rlctl.training.updates.mlp import (
    LOG_SQRT_TAU,
    Floats,
    MlpStack,
    SideBySide,
    join_outputs,
    share_gradients,
    share_joined,
)

_LOSS_EVERY = 32  # every so many updates the losses are computed, for the log only
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

    def __init__(self, actor: Any, side_by_side: SideBySide) -> None:
        self._actor = actor
        self._epsilon = float(actor.action_dist.epsilon)
        self._mean_limit = float(actor.clip_mean) if actor.use_sde and actor.clip_mean > 0 else None
        modules = _list_modules(actor)
        if actor.use_sde:
            networks = [modules]
            self._log_std_gradient = share_gradients([actor.log_std])[0]
        else:
            heads = [modules[-1], actor.log_std]
            joined = join_outputs(heads)
            networks = [[*modules[:-1], joined]]
        self.network = (choose_stack(modules) or MlpStack)(networks)
        self.network.run_calls = side_by_side.run
        if not actor.use_sde:
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
        return plain and len(actor.latent_pi) > 0 and choose_stack(_list_modules(actor)) is not None

    def reset_noise(self) -> None:
        """Draw gSDE's matrix with the numbers that SB3 would draw."""
        if self._actor.use_sde:
            std = self._actor.log_std.exp()
            self._actor.action_dist.exploration_mat = torch.randn(std.shape) * std
            torch.randn(std.shape)  # of the matrices for parallel exploration, which are not used here

    def sample(self, values: list[Floats]) -> Sample:
        """Draw actions from what the network's `run` returned for a batch of features."""
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
            self.network.backpropagate(sample.values, to_mean[None], latent=to_latent[None])
            return
        log_std = outputs[:, self._count :]
        within = (log_std >= _LOG_STD_MIN) & (log_std <= _LOG_STD_MAX)
        to_log_std = (to_mean * sample.noise - np.float32(to_log_prob)) * within
        self.network.backpropagate(sample.values, np.concatenate([to_mean, to_log_std], 1)[None])

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
        return to_noise @ matrix.T + latent * (to_variance @ variances.T) * 2


def _list_modules(actor: Any) -> list[Any]:
    mean = actor.mu[0] if isinstance(actor.mu, torch.nn.Sequential) else actor.mu  # gSDE clips it
    return [*actor.latent_pi, mean]


class SacUpdate:
    """Updates a SAC model whose networks are multi-layer perceptrons on the CPU."""

    algorithm: ClassVar[Any] = SAC
    first_update: ClassVar[int] = 0  # the number of the first one, of which every `policy_delay`th updates the actor

    def __init__(self, model: Any) -> None:
        self._model = model
        self._policy_delay = getattr(model, "policy_delay", 1)  # SB3's own models have none
        self._side_by_side = SideBySide(list(model.critic.q_networks), model.batch_size)
        self._actor = SquashedGaussianActor(model.actor, self._side_by_side)
        kind = choose_stack(model.critic.q_networks[0]) or MlpStack
        self._critics = self._side_by_side.make_stacks(model.critic.q_networks, kind)
        targets = getattr(model, "critic_target", None)  # CrossQ has none
        self._targets = [] if targets is None else self._side_by_side.make_stacks(targets.q_networks)
        self._followed = [values for critic in self._critics for values in critic.parameters]
        self._following = [values for target in self._targets for values in target.parameters]

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        if type(model) is not cls.algorithm:
            return False
        networks = model.critic.q_networks
        return SquashedGaussianActor.supports(model.actor) and all(choose_stack(network) for network in networks)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model = self._model
        optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)
        model._update_learning_rate([optimizer for optimizer in optimizers if optimizer is not None])
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for step, batch in enumerate(sample_batches(model, model.actor, gradient_steps, batch_size)):
            learns_actor = (model._n_updates + step + self.first_update) % self._policy_delay == 0
            self._update(batch, logged, learns_actor=learns_actor, with_loss=step % _LOSS_EVERY == 0)
            if self._targets and step % model.target_update_interval == 0:
                torch._foreach_lerp_(self._following, self._followed, model.tau)
        model._n_updates += gradient_steps
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _update(self, batch: Batch, logged: dict[str, list[float]], *, learns_actor: bool, with_loss: bool) -> None:
        self._actor.reset_noise()
        coefficient, sample = self._read_coefficient(), None
        calls = [functools.partial(self._actor.network.run, batch.next_features[None], "next")]
        if learns_actor:
            calls.insert(0, functools.partial(self._actor.network.run, batch.features[None], "learning"))
        passes = self._side_by_side.run(calls)
        if learns_actor:
            sample = self._actor.sample(passes[0])  # before the other: SB3's order of random numbers
            self._update_coefficient(sample, logged)
            logged["ent_coef"].append(coefficient)
        target = self._compute_target(batch, self._actor.sample(passes[-1]), coefficient)
        outputs = self._update_critics(np.concatenate([batch.features, batch.actions], 1), target)
        if with_loss:
            logged["critic_loss"].append(self._compute_loss(outputs, target))
        if sample is not None:
            logged["actor_loss"].append(self._update_actor(batch.features, sample, coefficient))

    def _read_coefficient(self) -> float:
        model = self._model
        tensor = model.ent_coef_tensor if model.ent_coef_optimizer is None else model.log_ent_coef.exp()
        return float(tensor.item())

    def _update_coefficient(self, sample: Sample, logged: dict[str, list[float]]) -> None:
        model = self._model
        if model.ent_coef_optimizer is None:
            return
        missing = -(float(sample.log_prob.mean()) + float(model.target_entropy))
        logged["ent_coef_loss"].append(model.log_ent_coef.item() * missing)
        model.log_ent_coef.grad = torch.full_like(model.log_ent_coef, missing)
        adam.step(model.ent_coef_optimizer)

    def _compute_target(self, batch: Batch, sample: Sample, coefficient: float) -> Floats:
        """Return the critics' targets, shape (batch, estimates)."""
        inputs = np.concatenate([batch.next_features, sample.action], 1)[None]
        passes = self._side_by_side.run([functools.partial(stack.run, inputs, "target") for stack in self._targets])
        estimates = self._choose_estimates(np.concatenate([values[-1] for values in passes]))
        return batch.rewards + batch.discounts * (estimates - coefficient * sample.log_prob)

    def _update_critics(self, inputs: Floats, target: Floats) -> Floats:
        """Return the critics' outputs before the update, shape (critics, batch, outputs)."""

        def learn(index: int) -> Floats:
            critics = self._critics[index]
            values = critics.run(inputs[None], "learning")
            critics.backpropagate(values, self._differentiate_loss(values[-1], target))
            return values[-1]

        outputs = self._side_by_side.run([functools.partial(learn, index) for index in range(len(self._critics))])
        adam.step(self._model.critic.optimizer)
        return np.concatenate(outputs)

    def _update_actor(self, features: Floats, sample: Sample, coefficient: float) -> float:
        """Return the actor's loss."""
        inputs = np.concatenate([features, sample.action], 1)[None]
        passes = self._side_by_side.run([functools.partial(critics.run, inputs, "actor") for critics in self._critics])
        value, to_outputs = self._value(np.concatenate([values[-1] for values in passes]))
        to_outputs /= -len(value)
        parts = zip(self._critics, passes, np.split(to_outputs, len(self._critics)), strict=True)
        size = features.shape[1]
        calls = [functools.partial(critics.input_gradient, values, part, size) for critics, values, part in parts]
        to_action = np.concatenate(self._side_by_side.run(calls)).sum(0)
        self._actor.backpropagate(sample, to_action, coefficient / len(value))
        adam.step(self._model.actor.optimizer)
        return float((coefficient * sample.log_prob - value).mean())

    def _choose_estimates(self, outputs: Floats) -> Floats:
        """Return the target critics' estimates that form the target, shape (batch, estimates)."""
        return outputs.min(0)

    def _compute_loss(self, outputs: Floats, target: Floats) -> float:
        return 0.5 * float(np.square(outputs - target).mean((1, 2)).sum())

    def _differentiate_loss(self, outputs: Floats, target: Floats) -> Floats:
        """Return the gradient of the critics' loss with respect to their outputs, shape (critics, batch, outputs)."""
        return (outputs - target) / np.float32(outputs.shape[1])

    def _value(self, outputs: Floats) -> tuple[Floats, Floats]:
        """Return the value from the critics' outputs, shape (batch, 1), and its gradient with respect to them."""
        to_outputs = (np.arange(len(outputs))[:, None, None] == outputs.argmin(0)).astype(np.float32)
        return outputs.min(0), to_outputs
