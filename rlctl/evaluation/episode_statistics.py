"""Statistics of a list of episodes.

Formulas of a line or two are written out: importing scipy.stats takes longer than many an evaluation.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Sequence

import numpy as np

from rlctl.rollout.collect import Episode
from rlctl.rollout.messages import EpisodeResult
from rlctl.run.robustness import Outcome


@dataclasses.dataclass(frozen=True)
class Spread:
    """How a quantity is distributed over episodes."""

    mean: float
    iqm: float
    """Interquartile mean: of the middle half, so that a few odd episodes do not decide."""
    std: float
    """Sample standard deviation; 0 for one episode."""
    min: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Describe values, one per episode."""
        array = np.asarray(values, np.float64)
        quarter = array.size // 4
        middle = np.sort(array)[quarter : array.size - quarter]
        return cls(
            mean=float(array.mean()),
            iqm=float(middle.mean()),
            std=float(array.std(ddof=1)) if array.size > 1 else 0.0,
            min=float(array.min()),
            max=float(array.max()),
        )


def success_rate(results: Sequence[EpisodeResult]) -> float | None:
    """Return the part of episodes that succeeded; None where the environment does not say."""
    known = [result.success for result in results if result.success is not None]
    return sum(known) / len(known) if known else None


def success_interval(results: Sequence[EpisodeResult]) -> tuple[float, float] | None:
    """Return the 95 % Wilson score interval of the success rate (E. B. Wilson, 1927)."""
    known = [result.success for result in results if result.success is not None]
    if not known:
        return None
    rate, count, z = sum(known) / len(known), len(known), statistics.NormalDist().inv_cdf(0.975)
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z * math.sqrt(rate * (1 - rate) / count + (z / (2 * count)) ** 2) / (1 + z**2 / count)
    return (centre - half if rate > 0 else 0.0), (centre + half if rate < 1 else 1.0)


def mean_return(results: Sequence[EpisodeResult]) -> float:
    """Return the mean of the episodes' sums of rewards."""
    return float(np.mean([result.total_reward for result in results]))


def summarize(results: Sequence[EpisodeResult]) -> Outcome:
    """Return the success rate and the mean return of episodes, with their intervals."""
    return Outcome(
        success_rate=success_rate(results),
        success_interval=success_interval(results),
        mean_return=mean_return(results),
        return_interval=mean_interval([result.total_reward for result in results]),
    )


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of independent values, by Student's t; the value itself, twice, for one."""
    from scipy.special import stdtrit

    mean, count = float(np.mean(values)), len(values)
    if count < 2:
        return mean, mean
    half = float(stdtrit(count - 1, 0.975)) * float(np.std(values, ddof=1)) / math.sqrt(count)
    return mean - half, mean + half


def mean_action_change(episodes: Sequence[Episode]) -> float:
    """Return the mean of |action - action before| over elements and steps of recorded episodes.

    It is 0 for actions that are no real numbers, and for episodes of one step.
    """
    changes = [
        np.abs(np.diff(each.trajectory.actions, axis=0)).ravel()
        for each in episodes
        if each.trajectory is not None and each.trajectory.actions.dtype.kind == "f"
    ]
    together = np.concatenate([np.zeros(0), *changes])
    return float(together.mean()) if together.size else 0.0


def mean_terms(results: Sequence[EpisodeResult]) -> dict[str, float]:
    """Return the mean over episodes of each weighted reward term's sum; the values add up to the mean return."""
    names = dict.fromkeys(name for result in results for name in result.terms)
    return {name: float(np.mean([result.terms.get(name, 0.0) for result in results])) for name in names}


def mean_metrics(results: Sequence[EpisodeResult]) -> dict[str, float]:
    """Return the mean over episodes of each metric's mean per step."""
    names = dict.fromkeys(name for result in results for name in result.metrics)
    return {name: float(np.mean([each.metrics[name] for each in results if name in each.metrics])) for name in names}
