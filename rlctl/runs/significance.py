"""Tests whether one policy or recipe is better than another: p-values, intervals, and how much data would decide.

Two policies are compared on the same episodes, so the unit is the episode and the test is paired. Two recipes are
compared by training each several times, so the unit is the training seed.

Success and return are tested together, and each candidate against the baseline. The p-values are adjusted for that:
if all are equal, at most `ALPHA` of the comparisons report a difference.
"""

import dataclasses
import enum
import itertools
import math
import statistics
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

Quantity = Literal["success", "return"]
Array = NDArray[np.float64]

ALPHA = 0.05  # a difference is significant below this p-value; intervals have the level 1 - ALPHA
POWER = 0.8
_RESAMPLES = 9999
_LEAST_PAIRS, _LEAST_SEEDS = 6, 4
"""The fewest pairs that differ, and seeds per recipe, with which an exact test can reach `ALPHA`."""


class Verdict(enum.StrEnum):
    """The result of comparing a candidate with the baseline."""

    BETTER = "better"
    WORSE = "worse"
    CANNOT_TELL = "cannot tell"


@dataclasses.dataclass(frozen=True)
class MeanDifference:
    """A candidate's mean minus the baseline's."""

    mean: float
    low: float  # lower end of the 95 % interval; equal to `mean` where there is nothing to resample
    high: float
    p: float  # two-sided p-value, adjusted for all tests; 1 if all pairs are equal
    needed: int | None
    """About how many episodes, or seeds per recipe, would decide if this is the true difference; None if it is 0."""

    @property
    def verdict(self) -> Verdict:
        """Whether the candidate is better or worse, where the p-value is below `ALPHA`."""
        if self.p >= ALPHA or self.mean == 0:
            return Verdict.CANNOT_TELL
        return Verdict.BETTER if self.mean > 0 else Verdict.WORSE


@dataclasses.dataclass(frozen=True)
class SeedDifference(MeanDifference):
    """The mean difference between two recipes, over training seeds."""

    probability_of_improvement: float
    """How often a training of the candidate beats one of the baseline; ties count half (Agarwal et al., 2021)."""
    smallest_p: float  # the smallest p-value that this number of seeds can reach


_Kind = TypeVar("_Kind", bound=MeanDifference)


def compare_episodes(
    baseline: Mapping[Quantity, Array], candidate: Mapping[Quantity, Array], comparisons: int = 1
) -> dict[Quantity, MeanDifference]:
    """Compare two policies by success and return on the same episodes, each of shape (episodes,), NaN where unknown.

    `comparisons` is how many candidates are compared with this baseline.
    """
    differences, changes = {}, []
    for quantity in baseline:
        one, two = baseline[quantity], candidate[quantity]
        known = np.isfinite(one) & np.isfinite(two)
        measure = success_difference if quantity == "success" else return_difference
        differences[quantity] = measure(one[known], two[known])
        changes.append(np.where(known, two - one, 0.0))
    return _adjust(differences, flip_signs(np.array(changes)), comparisons)


def compare_seeds(
    baseline: Mapping[Quantity, Array], candidate: Mapping[Quantity, Array], comparisons: int = 1
) -> dict[Quantity, SeedDifference]:
    """Compare two recipes by the scores of their training seeds, each of shape (seeds,); see `compare_episodes`."""
    differences = {quantity: seed_difference(baseline[quantity], candidate[quantity]) for quantity in baseline}
    p_values = exchange_seeds(np.array(list(baseline.values())), np.array(list(candidate.values())))
    return {
        quantity: dataclasses.replace(difference, smallest_p=min(1.0, comparisons * difference.smallest_p))
        for quantity, difference in _adjust(differences, p_values, comparisons).items()
    }


def _adjust(differences: Mapping[Quantity, _Kind], p_values: Array, comparisons: int) -> dict[Quantity, _Kind]:
    """Return the differences with p-values for all quantities together, and by Bonferroni for several candidates."""
    return {
        quantity: dataclasses.replace(difference, p=min(1.0, comparisons * max(difference.p, float(p))))
        for (quantity, difference), p in zip(differences.items(), p_values, strict=True)
    }


def flip_signs(differences: Array) -> Array:
    """Return the p-values, shape (quantities,), of paired differences, shape (quantities, episodes), tested together.

    Under the null hypothesis all differences of an episode can change their sign together. Step-down maximum of
    Westfall and Young (1993), which allows for the correlation of success and return.
    """
    moving = differences[:, differences.any(axis=0)]
    episodes = moving.shape[1]
    scale = np.sqrt((moving**2).sum(axis=1, keepdims=True))
    scaled = np.divide(moving, scale, out=np.zeros_like(moving), where=scale > 0)
    if exact := 2**episodes <= _RESAMPLES:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=episodes))).reshape(2**episodes, episodes)
    else:
        signs = 2.0 * _rng().integers(2, size=(_RESAMPLES, episodes), dtype=np.int8) - 1.0
    return _step_down(np.abs(scaled.sum(axis=1)), np.abs(signs @ scaled.T), exact)


def exchange_seeds(baseline: Array, candidate: Array) -> Array:
    """Return the p-values, shape (quantities,), of scores, shapes (quantities, seeds), of two recipes tested together.

    Under the null hypothesis seeds can be exchanged between the recipes; otherwise as `flip_signs`.
    """
    scores = np.concatenate([candidate, baseline], axis=1)
    count, total = candidate.shape[1], scores.shape[1]
    scores = scores - scores.mean(axis=1, keepdims=True)
    scale = scores.std(axis=1, keepdims=True)
    scaled = np.divide(scores, scale, out=np.zeros_like(scores), where=scale > 1e-12)
    if exact := math.comb(total, count) <= _RESAMPLES:
        chosen = np.array(list(itertools.combinations(range(total), count)))
    else:
        chosen = _rng().permuted(np.tile(np.arange(total), (_RESAMPLES, 1)), axis=1)[:, :count]
    # Of centred scores the sum over one recipe's seeds is proportional to the difference of means.
    return _step_down(np.abs(scaled[:, :count].sum(axis=1)), np.abs(scaled[:, chosen].sum(axis=2)).T, exact)


def _step_down(observed: Array, resampled: Array, exact: bool) -> Array:
    """Return p-values, shape (quantities,); `resampled`, shape (n, quantities), is the null distribution."""
    order = np.argsort(-observed)
    largest = np.maximum.accumulate(resampled[:, order[::-1]], axis=1)[:, ::-1]
    extreme = (largest >= observed[order] - 1e-9).sum(axis=0)
    p_values = np.empty(len(order))
    p_values[order] = np.maximum.accumulate(extreme / len(resampled) if exact else (extreme + 1) / (len(resampled) + 1))
    return p_values


def find_least_seeds(comparisons: int) -> tuple[int, float]:
    """Return the fewest seeds per recipe that can show a difference, and their smallest p-value."""
    for seeds in itertools.count(2):
        if (smallest := comparisons * 2 / math.comb(2 * seeds, seeds)) < ALPHA:
            return seeds, smallest
    raise AssertionError


def success_difference(baseline: Array, candidate: Array) -> MeanDifference:
    """Compare two policies' successes, 0 or 1, on the same episodes: McNemar's exact test (McNemar, 1947).

    Both of shape (episodes,). The interval is that of Agresti and Min (2005), which is not empty if no episode
    differs: half an episode is added to each of the four outcomes of a pair.
    """
    from scipy.stats import binomtest

    episodes, difference = baseline.size, candidate - baseline
    gained, lost = int((difference > 0).sum()), int((difference < 0).sum())
    p = float(binomtest(gained, gained + lost, 0.5).pvalue) if gained + lost else 1.0
    centre = (gained - lost) / (episodes + 2)
    half = _quantiles()[0] * math.sqrt((gained + lost + 1) / (episodes + 2) - centre**2) / math.sqrt(episodes + 2)
    needed = _episodes_for_success(gained, lost, episodes)
    return MeanDifference(float(difference.mean()), max(-1.0, centre - half), min(1.0, centre + half), p, needed)


def return_difference(baseline: Array, candidate: Array) -> MeanDifference:
    """Compare two policies' returns on the same episodes: a paired permutation test and a bootstrap interval.

    Both of shape (episodes,). Raises `ValueError` if the shapes differ.
    """
    from scipy.stats import permutation_test

    difference = candidate - baseline
    mean = float(difference.mean())
    if not difference.any():
        return MeanDifference(0.0, 0.0, 0.0, 1.0, None)
    test = permutation_test(
        (difference,), np.mean, permutation_type="samples", n_resamples=_RESAMPLES, vectorized=True, rng=_rng()
    )
    low, high = _interval((difference,), np.mean)
    std = float(difference.std(ddof=1)) if difference.size > 1 else math.nan
    return MeanDifference(mean, low, high, float(test.pvalue), _sample_size(mean, std, _LEAST_PAIRS))


def seed_difference(baseline: Array, candidate: Array) -> SeedDifference:
    """Compare two recipes by the final scores of their training seeds: a permutation test, exact for few seeds.

    Shapes (seeds,), two seeds or more each. The interval of the difference of means is a bootstrap over seeds.
    """
    from scipy.stats import permutation_test

    mean = float(candidate.mean() - baseline.mean())
    wins = np.sign(candidate[:, None] - baseline[None, :])
    improvement = float((wins + 1).mean() / 2)
    smallest = min(1.0, 2 / math.comb(baseline.size + candidate.size, baseline.size))
    p = 1.0
    if wins.any():
        result = permutation_test((candidate, baseline), _difference_of_means, n_resamples=_RESAMPLES, rng=_rng())
        p = float(result.pvalue)
    low, high = _interval((candidate, baseline), _difference_of_means)
    std = math.sqrt(float(candidate.var(ddof=1) + baseline.var(ddof=1)))
    return SeedDifference(mean, low, high, p, _sample_size(mean, std, _LEAST_SEEDS), improvement, smallest)


def interquartile_mean_interval(scores: Array) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the interquartile mean over seeds, shape (seeds,)."""
    from scipy.stats import trim_mean

    def middle(values: Array, axis: int = -1) -> Any:
        return trim_mean(values, 0.25, axis=axis)

    return _interval((scores,), middle)


def _difference_of_means(one: Array, two: Array, axis: int = -1) -> Any:
    return np.mean(one, axis=axis) - np.mean(two, axis=axis)


def _interval(samples: tuple[Array, ...], statistic: Any) -> tuple[float, float]:
    """Return a percentile bootstrap interval; if no sample varies, both ends are the statistic."""
    from scipy.stats import bootstrap

    if all(np.ptp(sample) == 0 for sample in samples):
        value = float(statistic(*samples))
        return value, value
    result = bootstrap(
        samples, statistic, confidence_level=1 - ALPHA, n_resamples=_RESAMPLES, method="percentile", rng=_rng()
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)  # the same data give the same result


def _sample_size(difference: float, std: float, least: int) -> int | None:
    """Return for how many samples a t-test would find the difference: ((z_a + z_b) std / difference)^2."""
    if difference == 0 or not math.isfinite(std):
        return None
    return max(least, math.ceil((sum(_quantiles()) * std / difference) ** 2))


def _episodes_for_success(gained: int, lost: int, episodes: int) -> int | None:
    """Return for how many pairs McNemar's test would find the difference (Connor, 1987)."""
    if gained == lost:
        return None
    disagreeing, difference = (gained + lost) / episodes, (gained - lost) / episodes
    alpha, beta = _quantiles()
    root = alpha * math.sqrt(disagreeing) + beta * math.sqrt(max(disagreeing - difference**2, 0.0))
    return math.ceil(max((root / difference) ** 2, _LEAST_PAIRS / disagreeing))


def _quantiles() -> tuple[float, float]:
    normal = statistics.NormalDist()
    return normal.inv_cdf(1 - ALPHA / 2), normal.inv_cdf(POWER)
