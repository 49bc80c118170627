"""Networks that do not depend on one another are updated side by side, on two cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import nn

from rlctl.rollout.workers import available_cores
from rlctl.training.updates.mlp import MlpStack, count_weights

Result = TypeVar("Result")

_WORTHWHILE = 8_000_000
"""Products of a forward pass from which on a thread saves more time than it costs."""


class SideBySide:
    """Makes several calls, the first of them on this thread and the others on a second one.

    For small networks and on one core, all on this thread. The results are the same to the last bit.
    """

    def __init__(self, networks: Sequence[Iterable[nn.Module]], batch_size: int) -> None:
        smallest = min(count_weights(network) for network in networks)
        self._second: ThreadPoolExecutor | None = None
        if batch_size * smallest >= _WORTHWHILE and available_cores() > 1:
            self._second = ThreadPoolExecutor(1, initializer=_prepare_thread)

    def make_stacks(self, networks: Iterable[Iterable[nn.Module]]) -> list[MlpStack]:
        """Return networks of equal shape as one stack, or as one each where a second thread is used."""
        if self._second is None:
            return [MlpStack(list(networks))]
        return [MlpStack([network]) for network in networks]

    def run(self, calls: Sequence[Callable[[], Result]]) -> list[Result]:
        """Return what each call returns."""
        if self._second is None:
            return [call() for call in calls]
        others = [self._second.submit(call) for call in calls[1:]]
        return [calls[0](), *(other.result() for other in others)]


def _prepare_thread() -> None:
    # Torch keeps both for each thread.
    torch.set_grad_enabled(False)
    torch.set_num_threads(1)
