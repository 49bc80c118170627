"""Statistics of a list of episodes.

Short formulas are written out: importing scipy.stats takes longer than many evaluations.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from rlctl.evaluation.robustness import Outcome
from rlctl.play.collect import Episode
from rlctl.play.messages import EpisodeResult


@dataclasses.dataclass(frozen=True)
class Spread:
    """How a quantity is distributed over episodes."""

    mean: float
    iqm: float  # interquartile mean: the mean of the middle half, which outliers do not change
    std: float  # sample standard deviation; 0 for one episode
    min: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Describe values, one per episode."""
        array = np.asarray(values, np.float64)
        quarter = array.size // 4
        return cls(
            mean=float(array.mean()),
            iqm=float(np.sort(array)[quarter : array.size - quarter].mean()),
            std=float(array.std(ddof=1)) if array.size > 1 else 0.0,
            min=float(array.min()),
            max=float(array.max()),
        )


def success_rate(results: Sequence[EpisodeResult]) -> float | None:
    """Return the fraction of episodes that succeeded; None if the environment does not report success."""
    known = [result.success for result in results if result.success is not None]
    return sum(known) / len(known) if known else None


def success_interval(results: Sequence[EpisodeResult]) -> tuple[float, float] | None:
    """Return the 95 % interval of the success rate by Clopper and Pearson (1934), which is conservative."""
    known = [result.success for result in results if result.success is not None]
    if not known:
        return None
    return _lower_bound(sum(known), len(known)), 1.0 - _lower_bound(len(known) - sum(known), len(known))


def _lower_bound(count: int, episodes: int) -> float:
    """Return the success rate at which `count` or more successes have a probability of 2.5 %."""
    if count == 0:
        return 0.0
    numbers = np.arange(1, episodes + 1)
    log_choices = np.cumsum(np.log((episodes + 1 - numbers) / numbers))[count - 1 :]
    numbers = numbers[count - 1 :]
    low, high = 0.0, 1.0
    for _ in range(50):
        rate = (low + high) / 2
        logs = log_choices + numbers * math.log(rate) + (episodes - numbers) * math.log1p(-rate)
        low, high = (rate, high) if np.exp(logs).sum() < 0.025 else (low, rate)
    return low


def mean_return(results: Sequence[EpisodeResult]) -> float:
    """Return the mean of the episodes' sums of rewards."""
    return float(np.mean([result.total_reward for result in results]))


def summarize(results: Sequence[EpisodeResult]) -> Outcome:
    """Return the success rate and the mean return of episodes, with their intervals."""
    return Outcome(
        success_rate=success_rate(results),
        success_interval=success_interval(results),
        mean_return=mean_return(results),
        return_interval=return_interval(results),
    )


def return_interval(results: Sequence[EpisodeResult]) -> tuple[float, float]:
    """Return the 95 % interval of the mean return."""
    return mean_interval([result.total_reward for result in results])


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of independent values, by Student's t; for one value both ends are it."""
    mean, count = float(np.mean(values)), len(values)
    if count < 2:
        return mean, mean
    half = _find_t(count - 1) * float(np.std(values, ddof=1)) / math.sqrt(count)
    return mean - half, mean + half


def _find_t(freedom: int) -> float:
    """Return Student's t of so many degrees of freedom, below which 97.5 % lie.

    By the finite sums of M. Abramowitz and I. Stegun, Handbook of Mathematical Functions (1964), 26.7.3 and 26.7.4.
    """
    is_odd = freedom % 2 == 1
    k = np.arange(1, (freedom - 1) // 2 if is_odd else freedom // 2)
    factors = 2 * k / (2 * k + 1) if is_odd else (2 * k - 1) / (2 * k)
    weights = np.concatenate([[1.0], np.cumprod(factors)])
    powers = 2 * np.arange(len(weights)) + is_odd

    def find_inside(t: float) -> float:
        """Return the probability between -t and t."""
        angle = math.atan(t / math.sqrt(freedom))
        total = math.sin(angle) * float(weights @ math.cos(angle) ** powers)
        if freedom == 1:
            total = 0.0
        return 2 / math.pi * (angle + total) if is_odd else total

    low, high = 0.0, 13.0  # of one degree of freedom it is 12.7
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if find_inside(middle) < 0.95 else (low, middle)
    return low


def mean_action_change(episodes: Sequence[Episode]) -> float:
    """Return the mean of |action - previous action| over elements and steps; 0 for discrete actions."""
    changes = [
        np.abs(np.diff(episode.trajectory.actions, axis=0)).ravel()
        for episode in episodes
        if episode.trajectory is not None and episode.trajectory.actions.dtype.kind == "f"
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
    return {
        name: float(np.mean([result.metrics[name] for result in results if name in result.metrics])) for name in names
    }
