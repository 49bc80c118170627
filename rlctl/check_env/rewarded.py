"""What the rules about rewards, success and hidden goals read of recorded episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.finding import NotApplicable, NotJudged
from rlctl.check_env.messages import Trajectory
from rlctl.check_env.records import Records

WITH_SEARCH = ("comparisons", "episodes", "starts", "search")
"""The experiments that record episodes of the first process's instance: nearly all there are."""
DISCOUNT = 0.99
"""The usual discount per step: what is more than a few hundred steps away hardly counts."""
TERMS, SUCCESS = "reward_terms/", "is_success"
ENOUGH_STEPS = 50
"""With fewer steps nothing is said about what never happens."""


def require_readable(records: Records) -> list[Trajectory]:
    """Return the episodes of a step at least, if flags and infos can be read; raises `NotJudged` otherwise."""
    records.require_built()
    if records.forms("step"):
        raise NotJudged("step does not return five values (RL201)")
    if any(form.type != "dict" for _, form in records.forms("info")):
        raise NotJudged("info is not a dict (RL204)")
    return _require_enough([each for each in records.require_alone() if each.steps])


def require_rewarded(records: Records) -> list[Trajectory]:
    """Return the same, if every reward is a finite number."""
    episodes = require_readable(records)
    if not all(each.reward_is_number.all() for each in episodes):
        raise NotJudged("the reward is not a number (RL204)")
    if not all(np.isfinite(each.rewards).all() for each in episodes):
        raise NotJudged("the reward is not finite (RL601)")
    return episodes


def require_terms(records: Records) -> list[Trajectory]:
    """Return those of them that have reward terms in info; raises `NotApplicable` if none has."""
    episodes = [each for each in require_rewarded(records) if has_terms(each)]
    if not episodes:
        raise NotApplicable("no reward_terms in info")
    return _require_enough(episodes)


def _require_enough(episodes: list[Trajectory]) -> list[Trajectory]:
    if sum(each.steps for each in episodes) < ENOUGH_STEPS:
        raise NotJudged(f"fewer than {ENOUGH_STEPS} steps were recorded")
    return episodes


def has_terms(episode: Trajectory) -> bool:
    """Say whether there are reward terms in info."""
    return any(name.startswith(TERMS) for name in episode.infos)


def find_terms(episode: Trajectory) -> dict[str, NDArray[np.float64]]:
    """Return the reward terms of an episode by name; NaN where one is not in info. Shape (T,) each."""
    terms = {}
    for name, series in episode.infos.items():
        if name.startswith(TERMS):
            values = np.full(episode.steps, np.nan)
            inside = (series.steps >= 1) & (series.steps <= episode.steps)
            values[series.steps[inside] - 1] = series.values[inside]
            terms[name.removeprefix(TERMS)] = values
    return terms


def find_constant_terms(episodes: Sequence[Trajectory]) -> dict[str, float]:
    """Return the terms that have one value at all steps of all episodes."""
    by_name: dict[str, list[NDArray[np.float64]]] = {}
    for episode in episodes:
        for name, values in find_terms(episode).items():
            by_name.setdefault(name, []).append(values)
    return {
        name: float(parts[0][0])
        for name, parts in by_name.items()
        if len(parts) == len(episodes) and all((part == parts[0][0]).all() for part in parts)
    }


def reports_success(episodes: Sequence[Trajectory]) -> bool:
    """Say whether `is_success` is in info, at least sometimes."""
    return any(SUCCESS in each.infos for each in episodes)


def has_succeeded(episode: Trajectory) -> bool:
    """Say whether `is_success` was true at any step."""
    return SUCCESS in episode.infos and bool((episode.infos[SUCCESS].values > 0).any())


def ends_in_success(episode: Trajectory) -> bool:
    """Say whether `is_success` was true at the last step."""
    series = episode.infos.get(SUCCESS)
    return series is not None and int(series.steps[-1]) == episode.steps and bool(series.values[-1] > 0)


def discounted_sum(rewards: NDArray[np.float64]) -> float:
    """Return the discounted sum of rewards, from the first of them on."""
    return float(rewards @ DISCOUNT ** np.arange(len(rewards)))


def discounted_steps(reward: float, steps: int) -> float:
    """Return the discounted sum of the same reward for so many steps."""
    return float(reward * (1 - DISCOUNT**steps) / (1 - DISCOUNT))


def longest_episode(records: Records, episodes: Sequence[Trajectory]) -> int:
    """Return how long an episode may last: the declared limit, or the longest that was recorded [steps]."""
    return records.require_built().max_steps or max(each.steps for each in episodes)


def summarize(episodes: Sequence[Trajectory]) -> str:
    """Return how much was recorded: `80 episodes with random, zero and searched actions (6,100 steps)`."""
    kinds = list(dict.fromkeys(each.actions for each in episodes))
    kinds_text = " and ".join([", ".join(kinds[:-1]), kinds[-1]]) if len(kinds) > 1 else kinds[0]
    return f"{len(episodes)} episodes with {kinds_text} actions ({sum(each.steps for each in episodes):,} steps)"
