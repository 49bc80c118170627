"""Updates of CrossQ without autograd; equal to sb3-contrib's `train` except for rounding.

A. Bhatt et al., CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
Simplicity, 2024, https://arxiv.org/abs/1902.05605.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from sb3_contrib import CrossQ

from rlctl.training.updates.batch_norm import NormalizedMlpStack, is_normalized
from rlctl.training.updates.sac import SacUpdate, list_actor_modules
from rlctl.training.updates.sac_gradients import CRITIC_LOSS, SacGradients, SacSettings


class CrossQGradients(SacGradients):
    """SAC's gradients without target networks: the critics see this and the next step in one normalized batch."""

    def normalize(self, actor: Sequence[Any], critics: Sequence[Sequence[Any]]) -> None:
        """Use the batch normalization in these modules."""
        if is_normalized(actor):
            self._actor.network = NormalizedMlpStack(self._actor.network, [actor])
        if is_normalized(critics[0]):
            self._critics = NormalizedMlpStack(self._critics, critics)

    def _differentiate_critics(self, block: int, rows: slice) -> None:
        coefficient, with_loss, _ = self._arrays["numbers"].tolist()
        next_features, count = self._take("next_features", rows), self._settings.rows
        sample = self._actor.sample(next_features, "next", self._take("next_normal", rows))
        features = np.concatenate([self._take("features", rows), next_features])
        actions = np.concatenate([self._take("actions", rows), sample.action])
        passed = self._critics.run(np.concatenate([features, actions], 1)[None], "learning")
        values = passed[-1][:, count:].min(0) - np.float32(coefficient) * sample.log_prob
        target = self._take("rewards", rows) + self._take("discounts", rows) * values
        outputs = passed[-1][:, :count]
        if with_loss:
            self._arrays["sums"][block, CRITIC_LOSS] = self._compute_loss(outputs, target)
        to_outputs = np.zeros_like(passed[-1])
        to_outputs[:, :count] = self._differentiate_loss(outputs, target)
        self._critics.backpropagate(passed, to_outputs, self._gradients[block][0])


class CrossQUpdate(SacUpdate):
    """Updates a CrossQ model whose networks are multi-layer perceptrons on the CPU."""

    algorithm: ClassVar[Any] = CrossQ
    gradients: ClassVar[type[SacGradients]] = CrossQGradients
    first_update: ClassVar[int] = 1
    has_targets: ClassVar[bool] = False
    noise: ClassVar[tuple[str, ...]] = ("next_normal", "normal")

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        gradients = self._blocks.work
        assert isinstance(gradients, CrossQGradients)
        critics = [list(network) for network in model.critic.q_networks]
        gradients.normalize(list_actor_modules(model.actor), critics)

    def _count_blocks(self, settings: SacSettings) -> int:
        return 1  # batch normalization needs all rows
