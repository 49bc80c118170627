"""A gate on the success rate that is decided as soon as the episodes allow it, by a test that is valid at any time.

For episodes that succeed with probability p, the ratio M(p) of the probability of what was seen under a uniform prior
to that under p is a martingale with mean 1, so it ever exceeds 1 / alpha with probability alpha at most (Ville's
inequality). The rates with a smaller ratio are a confidence sequence: an interval that holds for all numbers of
episodes together. Robbins, "Statistical Methods Related to the Law of the Iterated Logarithm", 1970.
"""

import math

ALPHA = 0.05
"""The largest probability that a gate is decided wrongly, however many episodes are played."""


def is_decided(successes: int, episodes: int, rate: float) -> bool:
    """Return whether the episodes exclude `rate` as the true success rate."""
    return _log_ratio(successes, episodes, rate) >= -math.log(ALPHA)


def is_settled(successes: int, episodes: int, planned: int, rate: float) -> bool:
    """Return whether the remaining episodes of those planned cannot change on which side of `rate` their rate is."""
    failures = episodes - successes
    return successes / planned >= rate or (planned - failures) / planned < rate


def find_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Return the lowest and highest success rate that the episodes do not exclude."""
    estimate = successes / episodes
    return _find_bound(successes, episodes, estimate, 0.0), _find_bound(successes, episodes, estimate, 1.0)


def _find_bound(successes: int, episodes: int, inside: float, outside: float) -> float:
    if not is_decided(successes, episodes, outside):
        return outside
    for _ in range(60):
        middle = (inside + outside) / 2
        if is_decided(successes, episodes, middle):
            outside = middle
        else:
            inside = middle
    return inside


def _log_ratio(successes: int, episodes: int, rate: float) -> float:
    """Return log M(rate): the beta function of the counts, divided by the likelihood."""
    failures = episodes - successes
    if (rate == 0.0 and successes) or (rate == 1.0 and failures):
        return math.inf
    mixture = math.lgamma(successes + 1) + math.lgamma(failures + 1) - math.lgamma(episodes + 2)
    likelihood = (successes * math.log(rate) if successes else 0.0) + (
        failures * math.log1p(-rate) if failures else 0.0
    )
    return mixture - likelihood
