"""How long one action takes, exported and in SB3."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rlctl.run.onnx_policy import OnnxPolicy
from rlctl.run.torch_policy import TorchPolicy

REPETITIONS = 300
WARM_UP = 30


@dataclasses.dataclass(frozen=True)
class Latency:
    """Median time for one observation [us]."""

    onnx_us: float
    """With everything: normalisation, network, bounds."""
    sb3_us: float
    """SB3's `policy.predict` of an observation that is normalised already."""

    @property
    def speedup(self) -> float:
        """How many times as fast as SB3 the file is."""
        return self.sb3_us / self.onnx_us


def measure(torch_policy: TorchPolicy, onnx_policy: OnnxPolicy) -> Latency:
    """Time both policies on one observation."""
    space = torch_policy.observation_space
    space.seed(0)
    observation = space.sample()
    normalized: Any = torch_policy.normalizer(observation)
    state, starts = _take_state_row(torch_policy), np.array([False])
    onnx_policy.reset()
    return Latency(
        onnx_us=_measure_median_us(lambda: onnx_policy.predict(observation)),
        sb3_us=_measure_median_us(
            lambda: torch_policy.network.predict(normalized, state=state, episode_start=starts, deterministic=True)
        ),
    )


def _take_state_row(policy: TorchPolicy) -> Any:
    state = policy.initial_state()
    return None if state is None else tuple(part[:, :1] for part in state)


def _measure_median_us(call: Callable[[], Any]) -> float:
    for _ in range(WARM_UP):
        call()
    times = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e6
