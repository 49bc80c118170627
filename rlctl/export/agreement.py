"""Comparing the actions of a torch policy with those of its exported file."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.run.torch_policy import TorchPolicy

MAX_DIFFERENCE = 1e-5
"""Largest |difference| of an action element; relative to the element where that is larger than 1."""


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How close two policies came on the same observations."""

    observations: int
    max_difference: float
    """Largest |difference| of an action element, in the action's own units."""
    beyond_limit: int
    """Actions that differ by more than the limit; for discrete actions, that differ at all."""
    near_ties: int
    """Discrete actions that differ because their logits agree within the limit: either choice is right."""
    batch_sizes: tuple[int, ...]
    """How many observations the exported policy was given at once."""

    @property
    def agrees(self) -> bool:
        """Whether no action differs by more than the limit."""
        return self.beyond_limit == 0


class Comparison:
    """Collects how far apart actions are. `add` right after the torch policy has acted: its logits are looked at."""

    def __init__(self, torch_policy: TorchPolicy) -> None:
        self.observations = 0
        self.batch_sizes = {1}
        self._space = torch_policy.action_space
        self._max_difference = 0.0
        self._beyond_limit = 0
        self._near_ties = 0
        self._logits: NDArray[np.float32]
        if not isinstance(self._space, spaces.Box):
            network: Any = torch_policy.network
            head = network.q_net.q_net[-1] if torch_policy.info.algo == "dqn" else network.action_net
            self._hook = head.register_forward_hook(self._keep_logits)

    def _keep_logits(self, module: Any, inputs: Any, output: Any) -> None:
        self._logits = output.detach().cpu().numpy()

    def add(self, expected: NDArray[Any], actions: NDArray[Any]) -> None:
        """Compare two arrays of actions, shape (rows, ...)."""
        difference = np.abs(expected.astype(np.float64) - actions).reshape(len(expected), -1)
        # Written so that NaN is beyond the limit.
        limit = MAX_DIFFERENCE * np.maximum(1.0, np.abs(expected)).reshape(difference.shape)
        differs = ~(difference <= limit).all(axis=1)
        if not isinstance(self._space, spaces.Box):
            for row in np.flatnonzero(differs).tolist():
                if self._is_near_tie(row, expected[row], actions[row]):
                    self._near_ties += 1
                    differs[row], difference[row] = False, 0.0
        self._max_difference = max(self._max_difference, float(difference.max()))
        self._beyond_limit += int(differs.sum())

    def _is_near_tie(self, row: int, expected: NDArray[Any], action: NDArray[Any]) -> bool:
        return all(
            margin <= MAX_DIFFERENCE * max(1.0, size)
            for margin, size in _list_margins(self._space, self._logits[row], expected, action)
        )

    def result(self) -> Agreement:
        """Return what was seen, and stop looking."""
        if not isinstance(self._space, spaces.Box):
            self._hook.remove()
        batch_sizes = tuple(sorted(self.batch_sizes))
        return Agreement(self.observations, self._max_difference, self._beyond_limit, self._near_ties, batch_sizes)


def _list_margins(
    space: spaces.Space[Any], logits: NDArray[np.float32], expected: NDArray[Any], action: NDArray[Any]
) -> list[tuple[float, float]]:
    """By how much, per choice, the logit of the expected one is ahead, and the size of that logit."""
    if isinstance(space, spaces.MultiBinary):  # against a logit of zero, which is a probability of one half
        wrong = np.flatnonzero(expected != action)
        return [(abs(float(logits[index])), 0.0) for index in wrong]
    sizes = space.nvec if isinstance(space, spaces.MultiDiscrete) else [len(logits)]
    groups = np.split(logits, np.cumsum(sizes)[:-1])
    choices = zip(groups, np.atleast_1d(expected), np.atleast_1d(action), strict=True)
    return [(float(group[ours] - group[theirs]), abs(float(group[ours]))) for group, ours, theirs in choices]
