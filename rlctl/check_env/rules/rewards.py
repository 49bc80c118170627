"""RL6: the reward, as a number."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.rules.known import lived
from rlctl.check_env.rules.tried import WITH_SEARCH, at, has_succeeded, in_words, rewarded

INFO, WARNING = Severity.INFO, Severity.WARNING

LARGE = 10.0
"""Root mean square per step from which a reward is large. With the usual discount a return is up to a hundred times
as much, and value networks begin near 0. Pendulum's rewards, down to -16, are below it."""
HUGE = 1_000.0
"""A single reward beyond this, ten times the usual bonus for finishing, spoils the value estimate of all before it."""


@rule(
    "RL601",
    "reward not finite",
    Severity.ERROR,
    "Find the division, logarithm or diverging simulation behind it.",
    complaints=(r"reward is (a|an) (nan|inf)", r"found (nan|inf).* in rewards"),
)
def finite(evidence: Evidence) -> Iterator[Seen]:
    """A reward is NaN or infinite. One such number turns all weights of a network into NaN."""
    for trajectory in lived(evidence):
        wrong = np.flatnonzero(~np.isfinite(trajectory.rewards) & trajectory.reward_is_number)
        if wrong.size:
            step, value = int(wrong[0]) + 1, str(trajectory.rewards[wrong[0]])
            message = f"the reward is {value} at step {step}"
            yield Seen(message, {**trajectory.place, "step": step, "value": value, "expected": "finite"})
            return


@rule(
    "RL602",
    "reward never changes",
    WARNING,
    "Let the reward say what is better: a term for the distance to the goal, or for progress. A sparse reward needs "
    "demonstrations, a curriculum, or many more steps.",
    needs=WITH_SEARCH,
)
def changes(evidence: Evidence) -> Iterator[Seen]:
    """Every step of everything that was tried has the same reward, and no episode ends early: there is nothing to
    learn from. A reward of 0 or below may be sparse, with a goal that was not found (MountainCar), which is only worth
    knowing; a positive one, or one that is the same in success too, is likely a mistake."""
    lives = rewarded(evidence)
    constant = float(lives[0].rewards[0])
    if any((life.rewards != constant).any() or life.terminated.any() for life in lives):
        return
    at_success = any(has_succeeded(life) for life in lives)
    beside = ", also where is_success is true" if at_success else ""
    yield Seen(
        f"the reward is {constant:g} at every step of {in_words(lives)}{beside}, and nothing ends an episode early",
        {"value": constant, "episodes": len(lives), "steps": sum(life.steps for life in lives)},
        WARNING if constant > 0 or at_success else INFO,
    )


@rule(
    "RL603",
    "reward badly scaled",
    WARNING,
    "Divide the reward by a constant so that a usual step is within [-1, 1], or normalise it (normalize: in the "
    "recipe, VecNormalize).",
)
def scale(evidence: Evidence) -> Iterator[Seen]:
    """Rewards are far outside [-10, 10]. The value network has to grow to their size first, gradients are clipped, and
    default learning rates do not fit. A single large reward at the end of an episode is common and not meant. Worth
    knowing only, where the recipe normalises."""
    rewarded(evidence)
    severity = INFO if evidence.normalizes else WARNING
    lives = [life for life in evidence.episodes if life.steps]
    inner = np.concatenate([life.rewards[:-1] if life.has_ended else life.rewards for life in lives] or [np.zeros(0)])
    size = float(np.sqrt(np.mean(inner**2))) if inner.size else 0.0
    largest = max(lives, key=lambda life: float(np.abs(life.rewards).max()), default=None)
    if largest is None:
        return
    step = int(np.abs(largest.rewards).argmax())
    value = float(largest.rewards[step])
    evidence_ = at(largest, step + 1, value=value, root_mean_square=size, expected=[-LARGE, LARGE])
    if size > LARGE:
        yield Seen(f"the reward per step is {size:.3g} (root mean square), up to {value:.3g}", evidence_, severity)
    elif abs(value) > HUGE:
        yield Seen(f"the reward is {value:.3g} at step {step + 1}; usual is {size:.2g}", evidence_, severity)
