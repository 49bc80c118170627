"""Updates of CrossQ without autograd; equal to sb3-contrib's `train` except for rounding.

A. Bhatt et al., CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
Simplicity, 2024, https://arxiv.org/abs/1902.05605.
"""

import functools
from typing import Any, ClassVar

import numpy as np
from sb3_contrib import CrossQ

from rlctl.training.updates import adam
from rlctl.training.updates.batches import Batch
from rlctl.training.updates.mlp import Floats, MlpStack
from rlctl.training.updates.sac import SacUpdate


class CrossQUpdate(SacUpdate):
    """SAC's update without target networks: the critics see this and the next step in one normalized batch."""

    algorithm: ClassVar[Any] = CrossQ
    first_update: ClassVar[int] = 1

    def _update(self, batch: Batch, logged: dict[str, list[float]], *, learns_actor: bool, with_loss: bool) -> None:
        self._actor.reset_noise()
        coefficient = self._read_coefficient()
        logged["ent_coef"].append(coefficient)
        loss = self._update_joint_critics(batch, coefficient)
        if with_loss:
            logged["critic_loss"].append(loss)
        if learns_actor:
            sample = self._actor.sample(self._actor.network.run(batch.features[None], "learning"))
            self._update_coefficient(sample, logged)
            logged["actor_loss"].append(self._update_actor(batch.features, sample, coefficient))

    def _update_joint_critics(self, batch: Batch, coefficient: float) -> float:
        """Return the critics' loss before the update."""
        sample = self._actor.sample(self._actor.network.run(batch.next_features[None], "next"))
        count, features = len(batch.features), np.concatenate([batch.features, batch.next_features])
        inputs = np.concatenate([features, np.concatenate([batch.actions, sample.action])], 1)[None]
        passes = self._side_by_side.run([functools.partial(stack.run, inputs, "learning") for stack in self._critics])
        values = np.concatenate([passed[-1] for passed in passes])[:, count:].min(0) - coefficient * sample.log_prob
        target = batch.rewards + batch.discounts * values

        def learn(critics: MlpStack, passed: list[Floats]) -> float:
            outputs = passed[-1][:, :count]
            to_outputs = np.zeros_like(passed[-1])
            to_outputs[:, :count] = self._differentiate_loss(outputs, target)
            critics.backpropagate(passed, to_outputs)
            return self._compute_loss(outputs, target)

        pairs = zip(self._critics, passes, strict=True)
        losses = self._side_by_side.run([functools.partial(learn, critics, passed) for critics, passed in pairs])
        adam.step(self._model.critic.optimizer)
        return sum(losses)
