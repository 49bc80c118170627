"""Is the exported file the policy? Compared on real rollouts, observation by observation and in closed loop."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.rollout.collect import Episode, run_episodes
from rlctl.rollout.seeds import Stream, episode_seeds
from rlctl.rollout.workers import Observations, Workers
from rlctl.run.onnx_policy import OnnxPolicy
from rlctl.run.policy import BatchActor
from rlctl.run.torch_policy import TorchPolicy

MAX_DIFFERENCE = 1e-5
"""Largest |difference| of an action element; relative to the element where that is larger than 1."""
MAX_RETURN_DIFFERENCE = 1e-3
MIN_OBSERVATIONS = 1000
EPISODES = 20
"""Episodes lived in closed loop by each of the two."""


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How close two policies came on the same observations."""

    observations: int
    max_difference: float
    """Largest |difference| of an action element, in the action's own units; 0 or more for discrete actions."""
    within_limit: bool
    near_ties: int
    """Discrete actions that differ because their logits agree within 1e-5: either choice is right."""
    batch_sizes: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class ClosedLoop:
    """The same episodes, lived once by each policy."""

    episodes: int
    same_success: int
    same_length: int
    max_return_difference: float
    """Relative to the larger of the episode's own return and the mean size of a return."""
    mean_return: float
    mean_return_onnx: float

    @property
    def agrees(self) -> bool:
        """Whether every episode had the same success and length, and a return within the limit."""
        same = self.same_success == self.same_length == self.episodes
        return same and self.max_return_difference <= MAX_RETURN_DIFFERENCE


class _Compared:
    """Acts with one policy and asks the other about every observation; each keeps its own recurrent state."""

    def __init__(self, torch_policy: TorchPolicy, onnx_policy: OnnxPolicy, n_envs: int) -> None:
        self._torch = BatchActor(torch_policy, n_envs)
        self._onnx = BatchActor(onnx_policy, n_envs)
        self._logits = _Logits(torch_policy.network) if _is_discrete(torch_policy) else None
        self._single = onnx_policy
        self.drives = "torch"
        self.observations = 0
        self.max_difference = 0.0
        self.max_excess = 0.0
        self.near_ties = 0
        self.batch_sizes: set[int] = set()

    def act(self, observations: Observations, rows: NDArray[np.int64], starts: NDArray[np.bool_]) -> NDArray[Any]:
        expected = self._torch.act(observations, rows, starts)
        actions = self._onnx.act(observations, rows, starts)
        raise NotImplementedError
