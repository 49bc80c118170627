"""How long one action takes, exported and in SB3."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

from rlctl.run.c_policy import CPolicy
from rlctl.run.policy import Policy
from rlctl.run.torch_policy import TorchPolicy

REPETITIONS = 300
WARM_UP = 30
_CALLS = 10  # of a C function within one measurement


@dataclasses.dataclass(frozen=True)
class Latency:
    """Median time for one observation [us]."""

    exported_us: float
    """With everything: normalisation, network, bounds. An ONNX file on onnxruntime, called from Python; C alone."""
    sb3_us: float
    """SB3's `policy.predict` of an observation that is normalised already."""

    @property
    def speedup(self) -> float:
        """How many times as fast as SB3 the file is."""
        return self.sb3_us / self.exported_us


def measure(torch_policy: TorchPolicy, exported: Policy) -> Latency:
    """Time both policies on one observation."""
    space = torch_policy.observation_space
    space.seed(0)
    observation = space.sample()
    normalized: Any = torch_policy.normalize(observation)
    exported.reset()
    return Latency(
        exported_us=_measure_exported(exported, observation),
        sb3_us=_measure_median_us(lambda: torch_policy.network.predict(normalized, deterministic=True)),
    )


def _measure_exported(exported: Policy, observation: Any) -> float:
    if isinstance(exported, CPolicy):
        return _measure_median_us(lambda: exported.repeat(observation, _CALLS)) / _CALLS
    return _measure_median_us(lambda: exported.predict(observation))


def _measure_median_us(call: Callable[[], Any]) -> float:
    for _ in range(WARM_UP):
        call()
    times = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e6
