"""What the episodes that failed have in common: what events drew, or what was observed at first."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.play.collect import Episode

_RELABELLED = 2000  # random relabellings of the episodes
_AT_ONCE = 100  # of them, so that 100,000 episodes need no gigabytes
_LARGEST_P = 0.01
_FEWEST = 5  # failures, and successes
_MOST_SHOWN = 3

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class FailurePattern:
    """A third of the episodes, by a condition that they began in, in which more failed than in the others."""

    condition: str
    where: Literal["at least", "at most", "far from the middle"]
    limit: float  # a value of the condition, or how far from the middle
    middle: float  # the median of all episodes
    failures: int
    episodes: int
    other_failures: int
    other_episodes: int
    p_value: float  # corrected for the number of conditions

    def __str__(self) -> str:
        sign = "<=" if self.where == "at most" else ">="
        name = f"|{self.condition} - {self.middle:.3g}|" if self.where == "far from the middle" else self.condition
        return (
            f"{self.failures} of {self.episodes} with {name} {sign} {self.limit:.3g} fail, "
            f"{self.other_failures} of {self.other_episodes} others (p = {self.p_value:.2g})"
        )


def find_patterns(episodes: Sequence[Episode], info: EnvInfo) -> list[FailurePattern]:
    """Return on which conditions failing depends, the clearest first; none if too few episodes failed or succeeded.

    Ranks of each condition, and of its distance from the median, are compared between failures and successes. A
    p-value is how often the largest of all these differences is as large when the episodes are relabelled at random
    (Westfall and Young 1993, maxT), so that many conditions do not find something where nothing is.
    """
    known = [episode for episode in episodes if episode.result.success is not None]
    failed = np.array([not episode.result.success for episode in known], bool)
    if min(failed.sum(), (~failed).sum()) < _FEWEST:
        return []
    conditions = _list_conditions(known, info)
    if not conditions:
        return []
    values = np.stack([*conditions.values()], axis=1)
    far = np.abs(values - np.median(values, axis=0))
    score, p_values = _compare(np.concatenate([_rank(values), _rank(far)], axis=1), failed)
    patterns: list[FailurePattern] = []
    for column in np.argsort(-np.abs(score), kind="stable").tolist():
        name = [*conditions][column % len(conditions)]
        if p_values[column] > _LARGEST_P or len(patterns) == _MOST_SHOWN:
            break
        if name not in [pattern.condition for pattern in patterns] and (column < len(conditions) or score[column] > 0):
            kind: Any = "far from the middle"
            if column < len(conditions):
                kind = "at least" if score[column] > 0 else "at most"
            patterns.append(_describe(name, kind, conditions[name], failed, float(p_values[column])))
    return patterns


def _list_conditions(episodes: Sequence[Episode], info: EnvInfo) -> dict[str, Array]:
    """Return the conditions that differ between episodes, a value per episode."""
    rows = [_read_conditions(episode, info) for episode in episodes]
    shared = [name for name in rows[0] if all(name in row for row in rows)]
    columns: dict[str, Array] = {}
    for name in shared:
        column = np.array([row[name] for row in rows], np.float64)
        same = any(np.array_equal(column, other) for other in columns.values())  # such as the values of a history
        if np.isfinite(column).all() and np.ptp(column) > 0 and not same:
            columns[name] = column
    return columns


def _read_conditions(episode: Episode, info: EnvInfo) -> dict[str, float]:
    drawn = {
        event if name == event else f"{event}/{name}": value
        for event, values in episode.result.drawn.items()
        for name, value in values.items()
    }
    return drawn | {name: value for key, row in episode.first.items() for name, value in _name(key, row, info)}


def _name(key: str, row: NDArray[Any], info: EnvInfo) -> list[tuple[str, float]]:
    """Name the elements of an observation: `command[0]`; of one without names `observation[3]`."""
    values = np.ravel(row).tolist()
    sizes: Mapping[str, int] = info.observation_sizes if not key else {key: len(values)}
    if sum(sizes.values()) != len(values):
        sizes = {"observation": len(values)}
    names = [name if size == 1 else f"{name}[{k}]" for name, size in sizes.items() for k in range(size)]
    return list(zip(names, values, strict=True))


def _rank(values: Array) -> Array:
    """Return the ranks within each column, shape as `values`; equal values have the mean of theirs."""
    ranks = np.empty_like(values)
    for column, row in enumerate(values.T):
        _, inverse, counts = np.unique(row, return_inverse=True, return_counts=True)
        last = np.cumsum(counts)
        ranks[:, column] = (last - (counts - 1) / 2)[inverse]
    return ranks


def _compare(ranks: Array, failed: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return how much higher the failures rank, in standard deviations, and the corrected p-value, per column."""
    spread = ranks.std(axis=0)
    standard = (ranks - ranks.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    score = standard[failed].mean(axis=0)
    rng = np.random.default_rng(0)
    largest = np.empty(_RELABELLED)
    for chosen in np.array_split(np.arange(_RELABELLED), _RELABELLED // _AT_ONCE):
        labels = rng.permuted(np.tile(failed, (len(chosen), 1)), axis=1).astype(float) / failed.sum()
        largest[chosen] = np.abs(labels @ standard).max(axis=1)
    as_large = (largest[:, None] >= np.abs(score) - 1e-12).sum(axis=0)
    return score, (1 + as_large) / (1 + _RELABELLED)


def _describe(name: str, where: Any, values: Array, failed: NDArray[np.bool_], p_value: float) -> FailurePattern:
    middle = float(np.median(values))
    measured = {"at least": values, "at most": -values, "far from the middle": np.abs(values - middle)}[where]
    limit = float(np.quantile(measured, 2 / 3, method="lower"))
    inside = measured >= limit
    return FailurePattern(
        name,
        where,
        -limit if where == "at most" else limit,
        middle,
        int((failed & inside).sum()),
        int(inside.sum()),
        int((failed & ~inside).sum()),
        int((~inside).sum()),
        p_value,
    )
