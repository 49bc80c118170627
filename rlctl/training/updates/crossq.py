"""Updates of CrossQ without autograd; equal to sb3-contrib's `train` except for rounding.

A. Bhatt et al., CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
Simplicity, 2024, https://arxiv.org/abs/1902.05605.
"""

import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import numpy as np
from sb3_contrib import CrossQ

from rlctl.play.workers import available_cores
from rlctl.training.updates.batch_norm import NormalizedMlpStack, is_normalized
from rlctl.training.updates.perceptrons import Floats, MlpStack, list_shapes
from rlctl.training.updates.sac import SacUpdate, list_actor_modules
from rlctl.training.updates.sac_gradients import CRITIC_LOSS, SacGradients, SacSettings

_WORTHWHILE = 8_000_000  # multiplications per forward pass of a critic from which a second thread saves time


class _SideBySide(MlpStack):
    """Critics that are computed on two threads; the results are bit-exact either way."""

    def __init__(self, stacks: Sequence[MlpStack], *, threads: bool) -> None:
        self._stacks = stacks
        self._second = ThreadPoolExecutor(1) if threads else None

    def _call(self, calls: Sequence[Callable[[], Any]]) -> list[Any]:
        if self._second is None:
            return [call() for call in calls]
        others = [self._second.submit(call) for call in calls[1:]]
        return [calls[0](), *(other.result() for other in others)]

    def run(self, inputs: Floats, use: str) -> list[Any]:
        """Return what each critic's `run` returns, then the outputs of all."""
        passes = self._call([functools.partial(stack.run, inputs, use) for stack in self._stacks])
        return [*passes, np.concatenate([passed[-1] for passed in passes])]

    def backpropagate(
        self, values: list[Any], gradient: Floats, gradients: Sequence[Floats], *, latent: Floats | None = None
    ) -> None:
        """Set the gradients of all parameters."""
        calls = []
        for index, (stack, passed) in enumerate(zip(self._stacks, values[:-1], strict=True)):
            one = slice(index, index + 1)
            arguments = passed, gradient[one], [part[one] for part in gradients]
            calls.append(functools.partial(stack.backpropagate, *arguments))
        self._call(calls)

    def input_gradient(self, values: list[Any], gradient: Floats, first: int) -> Floats:
        """Return the gradients of inputs `first` and later."""
        parts = zip(self._stacks, values[:-1], gradient[:, None], strict=True)
        calls = [functools.partial(stack.input_gradient, passed, part, first) for stack, passed, part in parts]
        return np.concatenate(self._call(calls))


class CrossQGradients(SacGradients):
    """SAC's gradients without target networks: the critics see this and the next step in one normalized batch."""

    def normalize(self, actor: Sequence[Any], critics: Sequence[Sequence[Any]]) -> None:
        """Use the batch normalization in these modules."""
        if is_normalized(actor):
            self._actor.network = NormalizedMlpStack(self._actor.network, [actor])
        if is_normalized(critics[0]):
            stacks = [NormalizedMlpStack(self._critics.select(index), [net]) for index, net in enumerate(critics)]
            weights = sum(math.prod(shape) for shape in list_shapes(self._settings.critic))
            self._critics = _SideBySide(
                stacks, threads=self._settings.rows * weights >= _WORTHWHILE and available_cores() > 1
            )

    def _differentiate_critics(self, block: int, rows: slice) -> None:
        coefficient, with_loss = np.float32(self._arrays["numbers"][0]), self._arrays["numbers"][1]
        next_features, count = self._take("next_features", rows), self._settings.rows
        seen = next_features[:, : self._settings.actor[0]]
        sample = self._actor.sample(seen, "next", self._take("next_normal", rows))
        features = np.concatenate([self._take("features", rows), next_features])
        actions = np.concatenate([self._take("actions", rows), sample.action])
        passed = self._critics.run(np.concatenate([features, actions], 1)[None], "learning")
        target = self._make_target(passed[-1][:, count:], coefficient * sample.log_prob, rows)
        outputs = passed[-1][:, :count]
        if with_loss:
            self._arrays["sums"][block, CRITIC_LOSS] = self._compute_loss(outputs, target)
        self._critics.backpropagate(passed, self._differentiate_loss(outputs, target), self._gradients[block][0])


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
