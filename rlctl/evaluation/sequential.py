"""A gate on the success rate that is decided as soon as the episodes allow it, by a test that is valid at any time.

For episodes that succeed with probability p, the ratio M(p) of the probability of what was seen under a uniform prior
to that under p is a martingale with mean 1, so it ever exceeds 1 / alpha with probability alpha at most (Ville's
inequality). The rates with a smaller ratio are a confidence sequence: an interval that holds for all numbers of
episodes together. Robbins, "Statistical Methods Related to the Law of the Iterated Logarithm", 1970.
"""

import bisect
import dataclasses
import math

ALPHA = 0.05
"""The largest probability that the interval ever excludes the true rate, however many episodes are played."""


@dataclasses.dataclass(frozen=True)
class EarlyGate:
    """A gate that may end an evaluation: on the measured success rate, or on the lower end of the interval.

    Of policies whose true rate is `rate`, or less, the lower end passes `ALPHA` at most. The measured rate has no such
    bound: where the interval does not decide, just under `rate` nearly half of them pass.
    """

    rate: float
    on_lower_end: bool

    def explain_end(self, successes: int, episodes: int, planned: int) -> str:
        """Return why no further episode is needed, as a sentence; empty if one is."""
        failures = episodes - successes
        if is_decided(successes, episodes, self.rate):
            return f"{self.rate:g} is outside the interval, which is valid at any time"
        if self.on_lower_end and not is_reachable(self.rate, planned, failures):
            return f"with {failures} failures the interval can no longer begin at {self.rate:g}"
        if not self.on_lower_end and is_settled(successes, episodes, planned, self.rate):
            kind = f"{successes} successes" if successes / planned >= self.rate else f"{failures} failures"
            return f"with {kind} the others cannot change the answer"
        return ""


def is_reachable(rate: float, planned: int, failures: int = 0) -> bool:
    """Return whether the interval lies above `rate` if of all planned episodes only so many fail."""
    successes = planned - failures
    return successes > rate * planned and is_decided(successes, planned, rate)


def find_least_episodes(rate: float) -> int:
    """Return the fewest episodes whose interval lies above `rate` if all succeed; 0 if no number of them is enough."""
    counts = range(1, 10**9)
    return bisect.bisect_left(counts, True, key=lambda count: is_reachable(rate, count)) + 1 if rate < 1 else 0


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
