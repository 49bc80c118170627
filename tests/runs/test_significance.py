"""The figures of a comparison, each with numbers from a formula or a published table."""

import statistics
import warnings

import numpy as np
import pytest

from rlctl.runs.compare.significance import (
    ALPHA,
    Verdict,
    compare_episodes,
    compare_seeds,
    exchange_seeds,
    find_least_seeds,
    flip_signs,
    interquartile_mean_interval,
)


def success_difference(baseline, candidate):
    return compare_episodes({"success": baseline}, {"success": candidate})["success"]


def return_difference(baseline, candidate):
    return compare_episodes({"return": baseline}, {"return": candidate})["return"]


def seed_difference(baseline, candidate):
    return compare_seeds({"return": baseline}, {"return": candidate})["return"]


def successes(*groups):
    return np.array([value for value, count in groups for _ in range(count)], np.float64)


def test_mcnemar_by_hand():
    # 10 episodes gained, 2 lost: p = 2 * P(at most 2 of 12) = 2 * (1 + 12 + 66) / 4096 = 0.038574
    baseline = successes((False, 10), (True, 2), (True, 88))
    candidate = successes((True, 10), (False, 2), (True, 88))
    difference = success_difference(baseline, candidate)
    assert difference.mean == pytest.approx(0.08)
    assert difference.p == pytest.approx(158 / 4096)
    assert difference.verdict is Verdict.BETTER
    assert success_difference(candidate, baseline).verdict is Verdict.WORSE


def test_equal_policies_do_not_differ_significantly():
    values = successes((True, 7), (False, 3))
    difference = success_difference(values, values)
    assert (difference.mean, difference.p, difference.needed) == (0.0, 1.0, None)
    assert difference.verdict is Verdict.CANNOT_TELL
    assert return_difference(values, values).verdict is Verdict.CANNOT_TELL
    # Agresti and Min: (0 + 0 + 1) / 12 under the root, 1.959964 * sqrt(1 / 12) / sqrt(12) = 0.163330
    assert (difference.low, difference.high) == pytest.approx((-0.163330, 0.163330), abs=1e-6)


def test_interval_of_a_difference_in_success_by_hand():
    # 10 gained, 2 lost of 100: 8 / 102 = 0.078431 -+ 1.959964 * sqrt(13 / 102 - 0.078431^2) / sqrt(102) = 0.067589
    difference = success_difference(successes((False, 10), (True, 90)), successes((True, 10), (False, 2), (True, 88)))
    assert (difference.low, difference.high) == pytest.approx((0.010842, 0.146020), abs=2e-6)


def test_episodes_needed_by_hand():
    # 3 gained, 1 lost of 100: mean 0.02, variance (0.04 - 0.0004) * 100 / 99 = 0.04;
    # (1.959964 + 0.841621)^2 * 0.04 / 0.02^2 = 784.9
    baseline = successes((False, 3), (True, 1), (True, 96))
    candidate = successes((True, 3), (False, 1), (True, 96))
    difference = success_difference(baseline, candidate)
    assert difference.p == pytest.approx(2 * 5 / 16)  # 2 * P(at most 1 of 4)
    assert difference.needed == 785


def test_fewer_pairs_than_can_decide_are_not_called_enough():
    # Five of five gained: p = 2 / 2^5 = 0.0625, and with six 2 / 2^6 = 0.031.
    difference = success_difference(np.zeros(5), np.ones(5))
    assert (difference.p, difference.needed, difference.verdict) == (0.0625, 6, Verdict.CANNOT_TELL)
    difference = return_difference(np.zeros(3), np.array([1.0, 1.0, 1.1]))
    assert (difference.p, difference.needed, difference.verdict) == (0.25, 6, Verdict.CANNOT_TELL)


def test_returns_are_paired():
    rng = np.random.default_rng(0)
    baseline = rng.normal(0.0, 100.0, 50)
    # A gain of 1 that the spread of 100 between episodes would hide if they were not paired.
    difference = return_difference(baseline, baseline + rng.normal(1.0, 0.5, 50))
    assert difference.verdict is Verdict.BETTER
    assert 0.8 < difference.low < difference.mean < difference.high < 1.2


def test_rounding_is_no_difference():
    baseline = np.random.default_rng(0).normal(20.0, 5.0, 100)
    assert return_difference(baseline, baseline * (1 - 1e-8)).verdict is Verdict.CANNOT_TELL


def test_unequal_groups_reach_half_the_p_value():
    difference = seed_difference(np.arange(4.0), np.arange(3.0) + 100.0)
    assert difference.p == pytest.approx(1 / 35)
    assert difference.smallest_p == pytest.approx(1 / 35)


def test_the_interval_of_few_seeds_is_welchs():
    # Means 2 and 12, variances 1 of 3 seeds each: 10 +- t(0.975, 4) * sqrt(1/3 + 1/3) = 10 +- 2.776 * 0.8165
    difference = seed_difference(np.array([1.0, 2.0, 3.0]), np.array([11.0, 12.0, 13.0]))
    assert (difference.low, difference.high) == pytest.approx((10 - 2.267, 10 + 2.267), abs=1e-3)


def test_one_side_that_does_not_vary():
    # Means 2 and 12, variances 1 and 0 of 3 seeds: 10 +- t(0.975, 2) * sqrt(1/3) = 10 +- 4.303 * 0.5774
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        difference = seed_difference(np.array([1.0, 2.0, 3.0]), np.full(3, 12.0))
    assert (difference.low, difference.high) == pytest.approx((10 - 2.484, 10 + 2.484), abs=1e-3)


@pytest.mark.parametrize(("seeds", "smallest"), [(3, 0.1), (4, 2 / 70), (5, 2 / 252)])
def test_smallest_p_of_so_many_seeds(seeds, smallest):
    difference = seed_difference(np.arange(seeds, dtype=float), np.arange(seeds) + 100.0)
    assert difference.p == pytest.approx(smallest)
    assert difference.smallest_p == pytest.approx(smallest)
    assert difference.probability_of_improvement == 1.0
    assert difference.verdict is (Verdict.CANNOT_TELL if seeds == 3 else Verdict.BETTER)


def test_probability_of_improvement_counts_ties_half():
    # Pairs (candidate, baseline): 1-1 tie, 1-2 loss, 3-1 win, 3-2 win: (0.5 + 0 + 1 + 1) / 4
    difference = seed_difference(np.array([1.0, 2.0]), np.array([1.0, 3.0]))
    assert difference.probability_of_improvement == pytest.approx(0.625)


def test_figures_over_seeds_are_those_of_rliable():
    from scipy.stats import mannwhitneyu, trim_mean

    # Its formulas: probability of improvement is Mann and Whitney's U over the number of pairs; the interval of the
    # interquartile mean is the percentile bootstrap over seeds of scipy's trim_mean(scores, 0.25).
    rng = np.random.default_rng(1)
    baseline, candidate = rng.normal(0.0, 1.0, 10).round(1), rng.normal(0.5, 1.0, 12).round(1)
    expected = mannwhitneyu(candidate, baseline).statistic / 120
    assert seed_difference(baseline, candidate).probability_of_improvement == pytest.approx(expected)
    resampled = trim_mean(candidate[rng.integers(12, size=(20_000, 12))], 0.25, axis=1)
    assert interquartile_mean_interval(candidate) == pytest.approx(np.percentile(resampled, [2.5, 97.5]), abs=0.05)
    assert interquartile_mean_interval(np.full(5, 2.0)) == (2.0, 2.0)
    assert interquartile_mean_interval(candidate[:4]) is None  # that of two seeds would be their range


def test_probability_of_improvement_of_normal_scores():
    # Of N(0, 1) and N(1, 1): P(Y > X) = Phi(1 / sqrt(2)) = 0.760250
    normal = statistics.NormalDist()
    scores = np.array([normal.inv_cdf((index + 0.5) / 200) for index in range(200)])
    assert seed_difference(scores, scores + 1.0).probability_of_improvement == pytest.approx(0.760250, abs=0.002)


@pytest.mark.slow
def test_intervals_cover_as_often_as_they_say():
    # 95 % intervals of the mean of 40 paired differences, 100 times; at least 88 is what a binomial allows (p > 0.001).
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(100):
        difference = return_difference(np.zeros(40), rng.normal(1.0, 2.0, 40))
        covered += difference.low <= 1.0 <= difference.high
    assert covered >= 86


def test_success_and_return_are_tested_together_by_hand():
    # Six episodes, all better in both: of 2^6 signs two are as extreme, and the two quantities go together.
    ones = np.ones(6)
    both = compare_episodes({"success": 0 * ones, "return": 0 * ones}, {"success": ones, "return": ones})
    assert [difference.p for difference in both.values()] == [2 / 64, 2 / 64]
    # Of three candidates each p-value counts three times.
    assert compare_episodes({"return": 0 * ones}, {"return": ones}, comparisons=3)["return"].p == 6 / 64
    # One episode of success tells nothing: its p-value stays 1, and that of the return does not become smaller.
    success = np.array([1.0, 0, 0, 0, 0, 0])
    mixed = compare_episodes({"success": 0 * ones, "return": 0 * ones}, {"success": success, "return": ones})
    assert mixed["success"].p == 1.0
    assert 2 / 64 <= mixed["return"].p <= 4 / 64


def test_seeds_of_two_quantities_are_exchanged_together():
    low, high = np.arange(4.0), np.arange(4.0) + 10
    both = compare_seeds({"success": low, "return": low}, {"success": high, "return": high})
    assert [difference.p for difference in both.values()] == pytest.approx([2 / 70, 2 / 70])
    assert compare_seeds({"return": low}, {"return": high}, comparisons=2)["return"].smallest_p == pytest.approx(4 / 70)
    two_seeds = {"return": np.arange(2.0)}, {"return": np.arange(2.0) + 10}
    assert compare_seeds(*two_seeds, comparisons=4)["return"].smallest_p == 1.0
    assert find_least_seeds(1) == (4, pytest.approx(2 / 70))
    assert find_least_seeds(2) == (5, pytest.approx(4 / 252))


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.5, 0.9])
def test_equal_policies_are_called_different_in_5_percent(rate):
    rng = np.random.default_rng(7)
    false_alarms = 0
    for _ in range(2000):
        success = (rng.random((2, 100)) < rate).astype(float)
        returns = rng.normal(0.0, 1.0, (2, 100)) + rng.normal(0.0, 1.0, 100) + success
        false_alarms += flip_signs(np.array([success[1] - success[0], returns[1] - returns[0]])).min() < ALPHA
    assert 0.04 <= false_alarms / 2000 <= 0.06


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [5, 8])
def test_equal_recipes_are_called_different_in_5_percent(seeds):
    rng = np.random.default_rng(8)
    false_alarms = 0
    for _ in range(2000):
        returns = rng.normal(0.0, 1.0, (2, seeds))
        success = rng.binomial(100, 1 / (1 + np.exp(-returns - rng.normal(0.0, 0.5, (2, seeds))))) / 100
        one, two = ([success[side], returns[side]] for side in (0, 1))
        false_alarms += exchange_seeds(np.array(one), np.array(two)).min() < ALPHA
    assert 0.04 <= false_alarms / 2000 <= 0.06
