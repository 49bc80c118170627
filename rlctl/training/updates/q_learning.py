"""Updates of DQN, TD3 and DDPG without autograd; equal to SB3's `train` except for rounding.

V. Mnih et al., Human-level control through deep reinforcement learning, Nature, 2015.
S. Fujimoto et al., Addressing Function Approximation Error in Actor-Critic Methods, 2018,
https://arxiv.org/abs/1802.09477.
"""

import collections
import functools
from typing import Any

import numpy as np
import torch
from stable_baselines3 import DDPG, DQN, TD3

from rlctl.training.updates import adam
from rlctl.training.updates.batches import Batch, sample_batches
from rlctl.training.updates.mlp import Floats, MlpStack, SideBySide, clip_norm, is_mlp


class DqnUpdate:
    """Updates a DQN model whose network is a multi-layer perceptron on the CPU."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._network, self._target = (MlpStack([net.q_net]) for net in (model.q_net, model.q_net_target))

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        return type(model) is DQN and is_mlp(model.q_net.q_net)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model = self._model
        model._update_learning_rate(model.policy.optimizer)
        losses = [self._update(batch) for batch in sample_batches(model, model.q_net, gradient_steps, batch_size)]
        model._n_updates += gradient_steps
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
        model.logger.record("train/loss", np.mean(losses))

    def _update(self, batch: Batch) -> float:
        """Return the loss before the update."""
        best = self._target.run(batch.next_features[None], "target")[-1][0].max(1, keepdims=True)
        values = self._network.run(batch.features[None], "learning")
        actions = batch.actions.astype(np.int64)
        errors = np.take_along_axis(values[-1][0], actions, 1) - (batch.rewards + batch.discounts * best)
        to_values = np.zeros_like(values[-1])
        # The derivative of the Huber loss is the error, clipped to [-1, 1].
        np.put_along_axis(to_values[0], actions, errors.clip(-1, 1) / np.float32(len(errors)), 1)
        self._network.backpropagate(values, to_values)
        clip_norm(self._network.gradients, self._model.max_grad_norm)
        adam.step(self._model.policy.optimizer)
        sizes = np.abs(errors)
        return float(np.where(sizes <= 1, 0.5 * np.square(sizes), sizes - 0.5).mean())


class Td3Update:
    """Updates a TD3 or DDPG model whose networks are multi-layer perceptrons on the CPU."""

    def __init__(self, model: Any) -> None:
        self._model = model
        # The last module of an actor is the tanh that squashes its actions.
        self._actor, self._actor_target = (MlpStack([actor.mu[:-1]]) for actor in (model.actor, model.actor_target))
        self._side_by_side = SideBySide(list(model.critic.q_networks), model.batch_size)
        self._critics = self._side_by_side.make_stacks(model.critic.q_networks)
        self._targets = self._side_by_side.make_stacks(model.critic_target.q_networks)
        self._followed = [values for stack in (*self._critics, self._actor) for values in stack.parameters]
        self._following = [values for stack in (*self._targets, self._actor_target) for values in stack.parameters]

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        if type(model) not in (TD3, DDPG):
            return False
        networks = (model.actor.mu[:-1], *model.critic.q_networks)
        return isinstance(model.actor.mu[-1], torch.nn.Tanh) and all(is_mlp(network) for network in networks)

    @torch.no_grad()
    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Do `gradient_steps` updates with minibatches of the replay buffer; log what SB3 logs."""
        model = self._model
        model._update_learning_rate([model.actor.optimizer, model.critic.optimizer])
        logged: dict[str, list[float]] = collections.defaultdict(list)
        for batch in sample_batches(model, model.actor, gradient_steps, batch_size):
            model._n_updates += 1
            logged["critic_loss"].append(self._update_critics(batch, self._compute_target(batch)))
            if model._n_updates % model.policy_delay == 0:
                logged["actor_loss"].append(self._update_actor(batch.features))
                torch._foreach_lerp_(self._following, self._followed, model.tau)
        for name, values in logged.items():
            model.logger.record(f"train/{name}", np.mean(values))
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _compute_target(self, batch: Batch) -> Floats:
        """Return the critics' targets, shape (batch, 1)."""
        model = self._model
        noise = np.empty(batch.actions.shape, np.float32)
        torch.from_numpy(noise).normal_(0, model.target_policy_noise)  # torch's generator, as in SB3
        noise = noise.clip(-model.target_noise_clip, model.target_noise_clip)
        action = np.tanh(self._actor_target.run(batch.next_features[None], "target")[-1][0])
        inputs = np.concatenate([batch.next_features, (action + noise).clip(-1, 1)], 1)[None]
        passes = self._side_by_side.run([functools.partial(stack.run, inputs, "target") for stack in self._targets])
        return batch.rewards + batch.discounts * np.concatenate([values[-1] for values in passes]).min(0)

    def _update_critics(self, batch: Batch, target: Floats) -> float:
        """Return the critics' loss before the update."""
        inputs = np.concatenate([batch.features, batch.actions], 1)[None]

        def learn(critics: MlpStack) -> float:
            values = critics.run(inputs, "learning")
            errors = values[-1] - target
            critics.backpropagate(values, errors * np.float32(2 / len(target)))
            return float(np.square(errors).mean((1, 2)).sum())

        losses = self._side_by_side.run([functools.partial(learn, critics) for critics in self._critics])
        adam.step(self._model.critic.optimizer)
        return sum(losses)

    def _update_actor(self, features: Floats) -> float:
        """Return the actor's loss."""
        passed = self._actor.run(features[None], "learning")
        action = np.tanh(passed[-1])
        first = self._critics[0]  # the actor learns from the first critic only
        values = first.run(np.concatenate([features[None], action], 2), "actor")
        to_value = np.zeros_like(values[-1])
        to_value[0] = -1 / len(features)
        to_action = first.input_gradient(values, to_value, features.shape[1])[:1]
        self._actor.backpropagate(passed, to_action * (1 - np.square(action)))
        adam.step(self._model.actor.optimizer)
        return -float(values[-1][0].mean())
