"""Tests whether one policy or recipe is better than another: p-values, intervals, and how much data would decide.

Two policies play the same episodes: the unit is the episode and the test is paired. Of two recipes the unit is the
training seed. Success and return are tested together, and each candidate against the baseline, with p-values adjusted
for that: if all are equal, at most `ALPHA` of the comparisons report a difference.
"""

import dataclasses
import enum
import itertools
import math
import statistics
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

ComparedQuantity = Literal["success", "return"]
Array = NDArray[np.float64]

ALPHA = 0.05  # a difference is significant below this p-value; intervals have the level 1 - ALPHA
POWER = 0.8
_RESAMPLES = 9999
_NORMAL = statistics.NormalDist()
_LEAST_TO_RESAMPLE = 5  # seeds of which a bootstrap is an interval
_LEAST_PAIRS, _LEAST_SEEDS = 6, 4  # the fewest differing pairs, and seeds per recipe, that can reach `ALPHA`


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
    p: float  # two-sided p-value, adjusted for all tests; 1 where nothing differs
    needed: int | None  # about how many episodes, or seeds per recipe, would decide; None for a difference of 0

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


def compare_episodes(
    baseline: Mapping[ComparedQuantity, Array], candidate: Mapping[ComparedQuantity, Array], comparisons: int = 1
) -> dict[ComparedQuantity, MeanDifference]:
    """Compare two policies by success and return on the same episodes, each of shape (episodes,), NaN where unknown.

    `comparisons` is how many candidates are compared with this baseline; p-values are adjusted by Bonferroni.
    """
    # An exported policy differs by rounding, in the same direction in every episode.
    equal = {quantity: np.isclose(candidate[quantity], baseline[quantity], rtol=1e-6) for quantity in baseline}
    changes = {name: np.where(equal[name], 0.0, candidate[name] - baseline[name]) for name in baseline}
    p_values = flip_signs(np.array([np.where(np.isfinite(change), change, 0.0) for change in changes.values()]))
    differences = {}
    for (quantity, change), p in zip(changes.items(), p_values, strict=True):
        known = change[np.isfinite(change)]
        mean, std = float(known.mean()), float(known.std(ddof=1)) if known.size > 1 else math.nan
        low, high = _success_interval(known) if quantity == "success" else _interval((known,), np.mean)
        needed = _sample_size(mean, std, _LEAST_PAIRS)
        differences[quantity] = MeanDifference(mean, low, high, min(1.0, comparisons * float(p)), needed)
    return differences


def compare_seeds(
    baseline: Mapping[ComparedQuantity, Array], candidate: Mapping[ComparedQuantity, Array], comparisons: int = 1
) -> dict[ComparedQuantity, SeedDifference]:
    """Compare two recipes by the final scores of their training seeds, each of shape (seeds,); see `compare_episodes`.

    Two seeds or more each. The interval of the difference of means is Welch's, because a bootstrap of few seeds is
    too narrow.
    """
    p_values = exchange_seeds(np.array(list(baseline.values())), np.array(list(candidate.values())))
    differences = {}
    for quantity, p in zip(baseline, p_values, strict=True):
        one, two = baseline[quantity], candidate[quantity]
        mean, std = float(two.mean() - one.mean()), math.sqrt(float(two.var(ddof=1) + one.var(ddof=1)))
        half = _welch_half_width(one, two)
        differences[quantity] = SeedDifference(
            mean,
            mean - half,
            mean + half,
            min(1.0, comparisons * float(p)),
            _sample_size(mean, std, _LEAST_SEEDS),
            probability_of_improvement=float((np.sign(two[:, None] - one[None, :]) + 1).mean() / 2),
            # Of equal numbers of seeds, the opposite order is as extreme.
            smallest_p=min(1.0, comparisons * (1 + (one.size == two.size)) / math.comb(one.size + two.size, one.size)),
        )
    return differences


def _welch_half_width(one: Array, two: Array) -> float:
    """Return half the width of Welch's interval of a difference of means; 0 where neither side varies."""
    from scipy.special import stdtrit

    errors = [float(side.var(ddof=1)) / side.size for side in (one, two)]  # squared standard errors
    if sum(errors) == 0:
        return 0.0
    freedom = sum(errors) ** 2 / sum(error**2 / (side.size - 1) for error, side in zip(errors, (one, two), strict=True))
    return float(stdtrit(freedom, 1 - ALPHA / 2)) * math.sqrt(sum(errors))


def flip_signs(differences: Array) -> Array:
    """Return the p-values, shape (quantities,), of paired differences, shape (quantities, episodes), tested together.

    Under the null hypothesis all differences of an episode can change their sign together. Step-down maximum of
    Westfall and Young (1993), which allows for the correlation of success and return. Of success alone it is McNemar's
    exact test, for few episodes; for more, signs are drawn at random.
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
    smallest = ((seeds, comparisons * 2 / math.comb(2 * seeds, seeds)) for seeds in itertools.count(2))
    return next(pair for pair in smallest if pair[1] < ALPHA)


def _success_interval(change: Array) -> tuple[float, float]:
    """Return the interval of Agresti and Min (2005) of the mean change of success, which is -1, 0 or 1 per episode.

    It is not empty if no episode differs: half an episode is added to each of the four outcomes of a pair.
    """
    episodes, changed = change.size + 2, float(np.abs(change).sum())
    centre = float(change.sum()) / episodes
    half = _NORMAL.inv_cdf(1 - ALPHA / 2) * math.sqrt((changed + 1) / episodes - centre**2) / math.sqrt(episodes)
    return max(-1.0, centre - half), min(1.0, centre + half)


def find_smallest_loss(episodes: int) -> float:
    """Return the loss of success that so many equal pairs of episodes do not exclude."""
    return -_success_interval(np.zeros(episodes))[0]


def find_least_pairs(margin: float) -> float:
    """Return the fewest equal pairs of episodes that exclude a loss of success above `margin`; may be infinite."""
    return max(2, math.ceil(_NORMAL.inv_cdf(1 - ALPHA / 2) / margin) - 2) if margin > 0 else math.inf


def interquartile_mean_interval(scores: Array) -> tuple[float, float] | None:
    """Return the 95 % bootstrap interval of the interquartile mean over seeds, shape (seeds,).

    None for fewer than `_LEAST_TO_RESAMPLE`: the interval of two seeds would be their range, which covers the
    median of all seeds in half of the cases only.
    """
    if scores.size < _LEAST_TO_RESAMPLE:
        return None
    from scipy.stats import trim_mean

    return _interval((scores,), lambda values, axis=-1: trim_mean(values, 0.25, axis=axis))


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
    quantiles = _NORMAL.inv_cdf(1 - ALPHA / 2) + _NORMAL.inv_cdf(POWER)
    return max(least, math.ceil((quantiles * std / difference) ** 2))
