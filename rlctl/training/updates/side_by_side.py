"""Updates independent networks in parallel, on two cores."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import nn

from rlctl.rollout.workers import available_cores
from rlctl.training.updates.mlp import MlpStack, count_weights

Result = TypeVar("Result")

_WORTHWHILE = 8_000_000  # multiplications per forward pass from which a second thread saves time


class SideBySide:
    """Runs the first of several calls on this thread and the others on a second one.

    For small networks or on one core all run on this thread. The results are bit-exact either way.
    """

    def __init__(self, networks: Sequence[Iterable[nn.Module]], batch_size: int) -> None:
        smallest = min(count_weights(network) for network in networks)
        self._second: ThreadPoolExecutor | None = None
        if batch_size * smallest >= _WORTHWHILE and available_cores() > 1:
            self._second = ThreadPoolExecutor(1, initializer=_prepare_thread)

    def make_stacks(self, networks: Iterable[Iterable[nn.Module]]) -> list[MlpStack]:
        """Return networks of equal shape as one stack, or, with a second thread, as one stack per network."""
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
    # Both are settings of a thread in torch.
    torch.set_grad_enabled(False)
    torch.set_num_threads(1)
