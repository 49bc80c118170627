"""What rules about the reward and about success ask of everything that was tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.evidence import Evidence, Trajectory
from rlctl.check_env.finding import NotApplicable, NotJudged
from rlctl.check_env.rules.known import built, lived

WITH_SEARCH = ("comparisons", "episodes", "starts", "search")
"""The studies that live alone on the probe's instance: nearly all that was tried."""
DISCOUNT = 0.99
"""The usual discount per step: what is more than a few hundred steps away hardly counts."""
TERMS, SUCCESS = "reward_terms/", "is_success"
ENOUGH_STEPS = 50
"""With fewer steps nothing is said about what never happens."""


def tried(evidence: Evidence) -> list[Trajectory]:
    """Return what was lived for at least a step, if all of it can be understood; raises `NotJudged` otherwise."""
    built(evidence)
    lives = [each for each in lived(evidence) if each.steps]
    if any(form.what == "step" for each in lives for form in each.forms):
        raise NotJudged("step does not return five values (RL201)")
    if any(form.what == "info" and form.type != "dict" for each in lives for form in each.forms):
        raise NotJudged("info is no dict (RL206)")
    return _enough(lives)


def rewarded(evidence: Evidence) -> list[Trajectory]:
    """Return the same, if every reward is a finite number."""
    lives = tried(evidence)
    if not all(each.reward_is_number.all() for each in lives):
        raise NotJudged("the reward is no number (RL205)")
    if not all(np.isfinite(each.rewards).all() for each in lives):
        raise NotJudged("the reward is not finite (RL601)")
    return lives


def _enough(lives: list[Trajectory]) -> list[Trajectory]:
    if sum(each.steps for each in lives) < ENOUGH_STEPS:
        raise NotJudged(f"fewer than {ENOUGH_STEPS} steps were lived")
    return lives


def termed(evidence: Evidence) -> list[Trajectory]:
    """Return the lives that have reward terms in info."""
    lives = [each for each in rewarded(evidence) if any(name.startswith(TERMS) for name in each.infos)]
    if not lives:
        raise NotApplicable("no reward_terms in info")
    return _enough(lives)


def terms(life: Trajectory) -> dict[str, NDArray[np.float64]]:
    """Return the reward terms of a life by name; NaN where one is not in info. Shape (T,) each."""
    found = {}
    for name, series in life.infos.items():
        if name.startswith(TERMS):
            values = np.full(life.steps, np.nan)
            inside = (series.steps >= 1) & (series.steps <= life.steps)
            values[series.steps[inside] - 1] = series.values[inside]
            found[name.removeprefix(TERMS)] = values
    return found


def reports_success(lives: Sequence[Trajectory]) -> bool:
    """Say whether `is_success` is in info, at least sometimes."""
    return any(SUCCESS in life.infos for life in lives)


def has_succeeded(life: Trajectory) -> bool:
    """Say whether `is_success` was true at any step."""
    return SUCCESS in life.infos and bool((life.infos[SUCCESS].values > 0).any())


def ends_in_success(life: Trajectory) -> bool:
    """Say whether `is_success` was true at the last step."""
    series = life.infos.get(SUCCESS)
    return series is not None and int(series.steps[-1]) == life.steps and bool(series.values[-1] > 0)


def discounted(rewards: NDArray[np.float64]) -> float:
    """Return the discounted sum of rewards, from the first of them on."""
    return float(rewards @ DISCOUNT ** np.arange(len(rewards)))


def worth_of(reward: float, steps: int) -> float:
    """Return what the same reward for so many steps is worth, discounted."""
    return float(reward * (1 - DISCOUNT**steps) / (1 - DISCOUNT))


def limit(evidence: Evidence, lives: Sequence[Trajectory]) -> int:
    """Return how long an episode may last: the declared limit, or the longest that was lived [steps]."""
    return built(evidence).max_steps or max(each.steps for each in lives)


def in_words(lives: Sequence[Trajectory]) -> str:
    """Say how much was tried: `80 episodes with random, zero and searched actions (6,100 steps)`."""
    kinds = list(dict.fromkeys(each.actions for each in lives))
    kinds_text = " and ".join([", ".join(kinds[:-1]), kinds[-1]]) if len(kinds) > 1 else kinds[0]
    return f"{len(lives)} episodes with {kinds_text} actions ({sum(each.steps for each in lives):,} steps)"


def at(life: Trajectory, step: int, **more: object) -> Mapping[str, object]:
    """Return a place in a life, for a finding's evidence."""
    return {**life.place, "step": step, **more}
