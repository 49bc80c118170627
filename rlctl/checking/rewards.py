"""Recorded rewards, their terms and successes, as the rules about them read them."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.records import CheckedEpisode, Records
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.term_names import split_name
from rlctl.environments.success import SUCCESS

WITH_SEARCH = ("comparisons", "episodes", "starts", "search")  # they play the first process's instance
DISCOUNT = 0.99  # per step: what is hundreds of steps away hardly counts
TERMS = "reward_terms/"
WEIGHED = "episodes with weighed terms"
RAW_TERMS = "metrics/"
"""The same without their weights, of tasks."""
REWARD_WORDS = {"reward", "rewards", "rew", "rews"}
TOTAL_WORDS = {"cumulative", "episode", "mean", "return", "scale", "sum", "total"}
"""Of the names of what is no term."""
SUM_TOLERANCE = 1e-3  # part of the reward or of 1: terms may be rounded for the log
FEW_WRONG = 0.02  # part of the steps: the last of an episode may have a bonus
ROUNDS = 5  # of a fit without the steps that have a bonus of their own
ORDINARY = 0.95  # part of the steps that have none
LEAST_WEIGHT = 1e-6  # what is 0 but for rounding
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
    """Return the same, if every reward is a finite number; with reward terms by `weigh_terms`, once for all rules."""
    episodes = _require_finite(records)
    if WEIGHED not in records.derived:
        records.derived[WEIGHED] = weigh_terms(episodes)
    weighed: list[CheckedEpisode] = records.derived[WEIGHED]
    return weighed


def _require_finite(records: Records) -> list[CheckedEpisode]:
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
    return _choose_with_terms(require_rewarded(records))


def require_logged_terms(records: Records) -> list[CheckedEpisode]:
    """Return the same, with the terms as they are in info."""
    return _choose_with_terms(_require_finite(records))


def _choose_with_terms(episodes: Sequence[CheckedEpisode]) -> list[CheckedEpisode]:
    chosen = [episode for episode in episodes if has_terms(episode)]
    if not chosen:
        raise NotApplicable("no reward_terms in info")
    return chosen


def weigh_terms(episodes: list[CheckedEpisode]) -> list[CheckedEpisode]:
    """Return episodes whose terms are the reward, where that can be had: terms without their weights get them, and are
    `RAW_TERMS` too, as those of tasks; numbers of info that are named after the reward, and those of any dictionary,
    are terms if they add up."""
    if any(has_terms(episode) for episode in episodes):
        with_terms = [episode for episode in episodes if has_terms(episode)]
        is_raw = len(with_terms) == len(episodes) and find_wrong_sums(with_terms).any()
        return (_apply_weights(episodes) or episodes) if is_raw else episodes
    for names in _list_groups(episodes):
        renamed = [_rename(episode, names) for episode in episodes]
        if all(has_terms(episode) for episode in renamed):
            found = renamed if not find_wrong_sums(renamed).any() else _apply_weights(renamed)
            if found:
                return found
    return episodes


def _list_groups(episodes: Sequence[CheckedEpisode]) -> list[dict[str, str]]:
    """Return the numbers of info that may be reward terms: new names by old ones, for each dictionary, and for single
    numbers that are named after the reward. Those named after it come first."""
    groups: dict[str, dict[str, str]] = {}
    others: dict[str, dict[str, str]] = {}
    for name in dict.fromkeys(name for episode in episodes for name in episode.infos):
        folder, _, term = name.rpartition("/")
        words = set(split_name(folder or term))
        is_named = bool(words & REWARD_WORDS)
        is_total = bool(words & TOTAL_WORDS | set(split_name(term)) & TOTAL_WORDS)
        if is_named and not is_total:
            groups.setdefault(folder, {})[name] = TERMS + term
        elif folder:
            others.setdefault(folder, {})[name] = TERMS + term
    return [group for group in [*groups.values(), *others.values()] if len(group) > 1]


def _rename(episode: CheckedEpisode, names: Mapping[str, str]) -> CheckedEpisode:
    return dataclasses.replace(episode, infos={names.get(name, name): one for name, one in episode.infos.items()})


def _apply_weights(episodes: Sequence[CheckedEpisode]) -> list[CheckedEpisode]:
    """Return the episodes with weighted terms, and those without weights as `RAW_TERMS`; empty where no weights make
    the terms the reward. A term that is always 0 has no weight that could be known."""
    weights = find_weights(episodes)
    found = []
    for episode in episodes if weights else ():
        infos = dict(episode.infos)
        for name, weight in weights.items():
            if (series := infos.get(TERMS + name)) is not None:
                infos[RAW_TERMS + name] = series
                infos[TERMS + name] = dataclasses.replace(series, values=weight * series.values)
        found.append(dataclasses.replace(episode, infos=infos))
    return found


def has_terms(episode: CheckedEpisode) -> bool:
    """Say whether there are reward terms in info."""
    return any(name.startswith(TERMS) for name in episode.infos)


def find_terms(episode: CheckedEpisode, kind: str = TERMS) -> dict[str, NDArray[np.float64]]:
    """Return the reward terms of an episode by name, or its `RAW_TERMS`; NaN where one is not in info. Shape (T,)
    each."""
    terms = {}
    for name, series in episode.infos.items():
        if name.startswith(kind):
            values = np.full(episode.steps, np.nan)
            inside = (series.steps >= 1) & (series.steps <= episode.steps)
            values[series.steps[inside] - 1] = series.values[inside]
            terms[name.removeprefix(kind)] = values
    return terms


def join_terms(episodes: Sequence[CheckedEpisode], kind: str = TERMS) -> dict[str, NDArray[np.float64]]:
    """Return the values that terms have at all steps of all episodes, of those that are in every episode."""
    by_name: dict[str, list[NDArray[np.float64]]] = {}
    for episode in episodes:
        for name, values in find_terms(episode, kind).items():
            by_name.setdefault(name, []).append(values)
    return {name: np.concatenate(parts) for name, parts in by_name.items() if len(parts) == len(episodes)}


def find_constant_terms(episodes: Sequence[CheckedEpisode]) -> dict[str, float]:
    """Return the terms that have one value at all steps of all episodes."""
    terms = join_terms(episodes)
    return {name: float(values[0]) for name, values in terms.items() if (values == values[0]).all()}


def sum_terms(episodes: Sequence[CheckedEpisode]) -> NDArray[np.float64]:
    """Return the sum of the terms at all steps of all episodes."""
    return np.concatenate([np.sum(list(find_terms(episode).values()), axis=0) for episode in episodes])


def find_wrong_sums(episodes: Sequence[CheckedEpisode]) -> NDArray[np.float64]:
    """Return how far the sum of the terms is from the reward at all steps, relative to the reward or to 1; all 0 where
    it hardly ever differs."""
    rewards = np.concatenate([episode.rewards for episode in episodes])
    off = np.abs(sum_terms(episodes) - rewards) / np.maximum(1.0, np.abs(rewards))
    off = np.nan_to_num(off)  # a step without terms
    is_wrong: NDArray[np.bool_] = off > SUM_TOLERANCE
    return np.where(is_wrong & (is_wrong.mean() > FEW_WRONG), off, 0.0)


def find_weights(episodes: Sequence[CheckedEpisode]) -> dict[str, float]:
    """Return constant weights with which all terms, and a constant, are the reward, also those of a part of the steps
    that have a bonus of their own; empty where there are none. A term that is always 0 has none."""
    terms = join_terms(episodes)
    rewards = np.concatenate([episode.rewards for episode in episodes])
    columns = [values for values in terms.values() if len(values) == len(rewards)]
    if not columns or len(columns) < len(terms):
        return {}
    table = np.column_stack([*columns, np.ones(len(rewards))])
    known = np.isfinite(table).all(axis=1) & np.isfinite(rewards)
    table, rewards = table[known], rewards[known]
    allowed = SUM_TOLERANCE * np.maximum(1.0, np.abs(rewards))
    chosen = np.arange(len(rewards))
    weights = np.zeros(table.shape[1])
    for _ in range(ROUNDS):
        weights = np.linalg.lstsq(table[chosen], rewards[chosen], rcond=None)[0]
        off = np.abs(table @ weights - rewards)
        if np.mean(off <= allowed) >= ORDINARY:
            found = zip([*terms, "constant"], weights.tolist(), strict=True)
            used = {name: weight for name, weight in found if abs(weight) > LEAST_WEIGHT}
            is_zero = {name for name, values in terms.items() if not values.any()}
            return used if used.keys() | is_zero >= terms.keys() else {}
        chosen = np.argsort(off)[: int(ORDINARY * len(rewards))]
    return {}


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


def discounted_steps(reward: float, steps: float) -> float:
    """Return the discounted sum of the same reward for so many steps."""
    return float(reward * (1 - DISCOUNT**steps) / (1 - DISCOUNT))


def summarize(episodes: Sequence[CheckedEpisode]) -> str:
    """Return how much was recorded: `80 episodes with random, zero and searched actions (6,100 steps)`."""
    kinds = list(dict.fromkeys(episode.actions for episode in episodes))
    kinds_text = " and ".join([", ".join(kinds[:-1]), kinds[-1]]) if len(kinds) > 1 else kinds[0]
    return f"{len(episodes)} episodes with {kinds_text} actions ({sum(episode.steps for episode in episodes):,} steps)"
