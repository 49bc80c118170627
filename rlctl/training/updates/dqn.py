"""DQN's updates without autograd; equal to SB3's `DQN.train` except for rounding.

V. Mnih et al., Human-level control through deep reinforcement learning, Nature, 2015.
"""

from typing import Any

import numpy as np
import torch
from stable_baselines3 import DQN

from rlctl.training.updates.batches import Batch, sample_batches
from rlctl.training.updates.mlp import MlpStack, clip_norm, is_mlp


class DqnUpdate:
    """Updates a DQN model whose network is a multi-layer perceptron on the CPU."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._network, self._target = (MlpStack([net.q_net]) for net in (model.q_net, model.q_net_target))

    @classmethod
    def supports(cls, model: Any) -> bool:
        """Return whether this class can update a model; SB3 updates all others."""
        return (
            type(model) is DQN and is_mlp(model.q_net.q_net) and not list(model.q_net.features_extractor.parameters())
        )

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
        self._model.policy.optimizer.step()
        sizes = np.abs(errors)
        return float(np.where(sizes <= 1, 0.5 * np.square(sizes), sizes - 0.5).mean())
