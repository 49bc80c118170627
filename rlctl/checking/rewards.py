"""Recorded rewards, their terms and successes, as the rules about them read them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.environments.success import SUCCESS

WITH_SEARCH = ("comparisons", "episodes", "starts", "search")  # they play the first process's instance
DISCOUNT = 0.99  # per step: what is hundreds of steps away hardly counts
TERMS = "reward_terms/"
ENOUGH_STEPS = 50  # With fewer steps no rule judges what never happens


def require_readable(records: Records) -> list[CheckedEpisode]:
    """Return the episodes of a step at least, if flags and infos can be read; raises `NotJudged` otherwise."""
    records.require_built()
    if records.forms("step"):
        raise NotJudged("step does not return five values (RL201)")
    if any(form.type != "dict" for _, form in records.forms("info")):
        raise NotJudged("info is not a dict (RL204)")
    return require_enough([episode for episode in records.require_alone() if episode.steps])


def require_rewarded(records: Records) -> list[CheckedEpisode]:
    """Return the same, if every reward is a finite number."""
    episodes = require_readable(records)
    if not all(episode.reward_is_number.all() for episode in episodes):
        raise NotJudged("the reward is not a number (RL204)")
    if not all(np.isfinite(episode.rewards).all() for episode in episodes):
        raise NotJudged("the reward is not finite (RL601)")
    return episodes


def require_enough(episodes: list[CheckedEpisode]) -> list[CheckedEpisode]:
    """Return the episodes; raises `NotJudged` if they have too few steps to judge what never happens."""
    if sum(episode.steps for episode in episodes) < ENOUGH_STEPS:
        raise NotJudged(f"fewer than {ENOUGH_STEPS} steps were recorded")
    return episodes


def require_terms(records: Records) -> list[CheckedEpisode]:
    """Return the rewarded episodes with reward terms; raises `NotApplicable` where there are none."""
    episodes = [episode for episode in require_rewarded(records) if has_terms(episode)]
    if not episodes:
        raise NotApplicable("no reward_terms in info")
    return episodes


def has_terms(episode: CheckedEpisode) -> bool:
    """Say whether there are reward terms in info."""
    return any(name.startswith(TERMS) for name in episode.infos)


def find_terms(episode: CheckedEpisode) -> dict[str, NDArray[np.float64]]:
    """Return the reward terms of an episode by name; NaN where one is not in info. Shape (T,) each."""
    terms = {}
    for name, series in episode.infos.items():
        if name.startswith(TERMS):
            values = np.full(episode.steps, np.nan)
            inside = (series.steps >= 1) & (series.steps <= episode.steps)
            values[series.steps[inside] - 1] = series.values[inside]
            terms[name.removeprefix(TERMS)] = values
    return terms


def find_constant_terms(episodes: Sequence[CheckedEpisode]) -> dict[str, float]:
    """Return the terms that have one value at all steps of all episodes."""
    by_name: dict[str, list[NDArray[np.float64]]] = {}
    for episode in episodes:
        for name, values in find_terms(episode).items():
            by_name.setdefault(name, []).append(values)
    terms = {name: np.concatenate(parts) for name, parts in by_name.items() if len(parts) == len(episodes)}
    return {name: float(values[0]) for name, values in terms.items() if (values == values[0]).all()}


def reports_success(episodes: Sequence[CheckedEpisode]) -> bool:
    """Say whether `is_success` is in info, at least sometimes."""
    return any(SUCCESS in episode.infos for episode in episodes)


def has_succeeded(episode: CheckedEpisode) -> bool:
    """Say whether `is_success` was true at any step."""
    return SUCCESS in episode.infos and bool((episode.infos[SUCCESS].values > 0).any())


def ends_in_success(episode: CheckedEpisode) -> bool:
    """Say whether `is_success` was true at the last step."""
    series = episode.infos.get(SUCCESS)
    return series is not None and int(series.steps[-1]) == episode.steps and bool(series.values[-1] > 0)


def discounted_sum(rewards: NDArray[np.float64]) -> float:
    """Return the discounted sum of rewards, from the first of them on."""
    return float(rewards @ DISCOUNT ** np.arange(len(rewards)))


def discounted_steps(reward: float, steps: int) -> float:
    """Return the discounted sum of the same reward for so many steps."""
    return float(reward * (1 - DISCOUNT**steps) / (1 - DISCOUNT))


def summarize(episodes: Sequence[CheckedEpisode]) -> str:
    """Return how much was recorded: `80 episodes with random, zero and searched actions (6,100 steps)`."""
    kinds = list(dict.fromkeys(episode.actions for episode in episodes))
    kinds_text = " and ".join([", ".join(kinds[:-1]), kinds[-1]]) if len(kinds) > 1 else kinds[0]
    return f"{len(episodes)} episodes with {kinds_text} actions ({sum(episode.steps for episode in episodes):,} steps)"
