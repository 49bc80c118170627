"""RL110, RL112 and RL114: numbers in an observation that say nothing, are of quite different size, or are left out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.experiment import check
from rlctl.check_env.finding import Finding, NotApplicable, NotJudged, Severity, list_names
from rlctl.check_env.leaves import Leaf
from rlctl.check_env.messages import Trajectory
from rlctl.check_env.records import Records
from rlctl.check_env.rewarded import WITH_SEARCH, require_rewarded

Numbers = NDArray[np.float64]

FEWEST_ROWS = 50
FEWEST_SEEDS = 3
MOST_ROWS = 1_000
"""Observations that are compared element by element: more would only cost time."""
MOST_ELEMENTS = 1_500
"""A larger array is not a list of measurements."""
MOST_NAMED = 8
APART = 1_000.0
"""Ratio of scales from which the smaller elements are invisible to a network of usual initial weights."""
STILL = 1e-6
"""Relative to its size: an element that varies less is noise of the simulation."""
_Steps = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]
"""Of n steps: the seed and the number in its episode of each, its features (observation before, observation after,
action; shape (n, elements)), and its reward."""
NEAR, NEAR_ACTION = 0.05, 0.25
"""Two steps are alike where each number of both observations is as near as this, and each of the actions (much of which
the observations show already), in units of its standard deviation over everything that was recorded."""
MOST_STEPS = 2_000
"""Steps that are compared, each with each."""
MOST_PAIRS = 20_000
FEWEST_PAIRS = 30
FEWEST_ALIKE_SEEDS = 4
"""Seeds among which alike steps are found: with fewer it may be something special of one episode."""
LARGE_PART = 0.25
"""How different the rewards of alike steps of different episodes have to be, against those of all steps (standard
deviation): half of the pairs at least."""
TIMES = 10.0
"""How much larger that has to be than between alike steps of one episode, where a goal is the same but noise is not."""


def _rows(records: Records, index: int) -> Numbers:
    """Return the observations of one leaf, flat. Shape (n, elements)."""
    recorded = records.series(index)
    if not recorded:
        raise NotJudged("no observation of the declared shape was recorded")
    rows = np.concatenate([series.values for _, series in recorded])
    seeds = len({trajectory.seed for trajectory, _ in recorded})
    if len(rows) < FEWEST_ROWS or seeds < FEWEST_SEEDS:
        raise NotJudged(f"only {len(rows)} observations with {seeds} seeds were recorded")
    return rows.reshape(len(rows), -1)


def _vectors(records: Records) -> Iterator[tuple[int, Leaf, Numbers]]:
    """Yield the leaves that are lists of measurements (floats, no image, not too large), with some of their rows."""
    for index, leaf in enumerate(records.require_built().leaves):
        is_float = leaf.supported and leaf.kind == "Box" and np.dtype(leaf.dtype).kind == "f"
        if is_float and not _is_image(leaf) and 0 < np.prod(leaf.shape) <= MOST_ELEMENTS:
            rows = _rows(records, index)
            yield index, leaf, rows[:: max(1, -(-len(rows) // MOST_ROWS))].astype(np.float64)


def _is_image(leaf: Leaf) -> bool:
    return len(leaf.shape) == 3 and (leaf.dtype == "uint8" or min(leaf.shape[0], leaf.shape[-1]) in (1, 3, 4))


@check("RL110", *WITH_SEARCH)
def _find_constant_elements(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    names: list[str] = []
    total = 0
    has_constant_leaf = False
    for index, leaf in enumerate(built.leaves):
        size = int(np.prod(leaf.shape))
        if leaf.supported and size and not _is_image(leaf):
            rows = _rows(records, index)
            constant = _constant(rows, leaf)
            total += size
            has_constant_leaf |= len(constant) == size
            names += [f"{built.element(index, int(each))} ({float(rows[0, each]):.4g})" for each in constant]
    if names:
        yield Finding(
            "RL110",
            f"{len(names)} of {total} elements of the observation never changed: {list_names(names, MOST_NAMED)}",
            {"value": len(names), "expected": 0, "elements": [each.partition(" (")[0] for each in names[:MOST_NAMED]]},
            Severity.WARNING if has_constant_leaf else Severity.INFO,
        )


def _constant(rows: Numbers, leaf: Leaf) -> NDArray[np.intp]:
    """Return what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return np.zeros(0, np.intp)
    return np.flatnonzero(still & (low < high))


@check("RL112", *WITH_SEARCH)
def _find_unequal_scales(records: Records) -> Iterator[Finding]:
    built = records.require_built()
    for index, _, rows in _vectors(records):
        rows = rows[np.isfinite(rows).all(axis=1)]
        deviations = rows.std(axis=0)
        moving = np.flatnonzero(deviations > STILL * np.maximum(1.0, np.abs(rows).max(axis=0, initial=0.0)))
        ordered = moving[np.argsort(deviations[moving])]
        if len(ordered) < 2 or deviations[ordered[-1]] <= APART * deviations[ordered[0]]:
            continue
        if normalizes := records.normalizes():
            return
        large, small = int(ordered[-1]), int(ordered[0])
        ratio, names = float(deviations[large] / deviations[small]), [built.element(index, i) for i in (large, small)]
        recipe = "no recipe says to normalise" if normalizes is None else "the recipe does not normalise"
        yield Finding(
            "RL112",
            f"{names[0]} varies by {deviations[large]:.3g}, {names[1]} by {deviations[small]:.3g}: {ratio:.2g} times "
            f"less, and {recipe}",
            {"value": ratio, "expected": f"up to {APART:g}", "elements": names},
            Severity.INFO if normalizes is None else Severity.WARNING,
        )


@check("RL114", *WITH_SEARCH)
def find_hidden_goal(records: Records) -> Iterator[Finding]:
    """Compare the rewards of steps that look alike, of different episodes and of one."""
    seeds, numbers, features, rewards = _steps(records, require_rewarded(records))
    one, two = _alike(features)
    differences = np.abs(rewards[one] - rewards[two])
    across = seeds[one] != seeds[two]
    # Of one episode, recorded twice perhaps, but at different times: chance in the reward would show.
    within = ~across & (numbers[one] != numbers[two])
    different_seeds = len(np.unique(seeds[np.concatenate([one[across], two[across]])]))
    if across.sum() < FEWEST_PAIRS or within.sum() < FEWEST_PAIRS or different_seeds < FEWEST_ALIKE_SEEDS:
        return  # no two episodes came to the same state
    different, same = float(np.median(differences[across])), float(np.median(differences[within]))
    if different > LARGE_PART * float(rewards.std()) and different > TIMES * same:
        pair = np.flatnonzero(across)[int(differences[across].argmax())]
        first, second = int(one[pair]), int(two[pair])
        yield Finding(
            "RL114",
            f"with {different_seeds} seeds, steps that look alike have rewards {different:.3g} apart (median of "
            f"{across.sum():,} pairs), within one episode {same:.2g}: {rewards[first]:.4g} and "
            f"{rewards[second]:.4g}, say",
            {
                "seed": int(seeds[second]),
                "step": int(numbers[second]),
                "value": float(rewards[second]),
                "expected": float(rewards[first]),
                "other_seed": int(seeds[first]),
                "other_step": int(numbers[first]),
            },
        )


def _steps(records: Records, episodes: list[Trajectory]) -> _Steps:
    """Return some steps of all kinds of episodes; their features are in units of what is near."""
    leaves = records.require_built().leaves
    if not leaves or any(not leaf.supported for leaf in leaves):
        raise NotApplicable("a part of the observation cannot be compared")
    if any(len(leaf.shape) == 3 for leaf in leaves):
        raise NotApplicable("images are not compared")
    parts = [part for each in episodes for part in _steps_of(each, len(leaves))]
    if not parts:
        raise NotApplicable("no whole observation was recorded")
    seeds, numbers, features, rewards = (np.concatenate(each) for each in zip(*parts, strict=True))
    # Some, evenly, of the beginnings of episodes, where they are most alike, and as many of all others.
    halves = [np.flatnonzero(numbers <= 3), np.flatnonzero(numbers > 3)]
    chosen = np.concatenate([each[:: max(1, -(-len(each) * 2 // MOST_STEPS))] for each in halves])
    near = NEAR * features.std(axis=0)
    near[features.shape[1] - episodes[0].action_values.shape[1] :] *= NEAR_ACTION / NEAR
    # Whole numbers, of places and kinds, are alike only if they are equal.
    whole = (features == np.round(features)).all(axis=0)
    near[whole] = np.minimum(near[whole], 0.5)
    scaled = features[chosen] / np.where(near > 0, near, 1.0)
    return seeds[chosen], numbers[chosen], scaled, rewards[chosen]


def _steps_of(episode: Trajectory, leaves: int) -> Iterator[_Steps]:
    """Yield the steps of an episode whose observations are all known and finite; a last one that ends is left out."""
    steps = episode.steps - (episode.ended in ("terminated", "both", "raised"))
    series = [episode.observations.get(index) for index in range(leaves)]
    flat = [each.values.reshape(len(each.values), -1).astype(np.float64) for each in series if each is not None]
    if steps < 1 or [len(each) for each in flat] != [episode.steps + 1] * leaves:
        return
    observations = np.concatenate(flat, axis=1)
    if np.isfinite(observations).all():
        parts = [observations[:steps], observations[1 : steps + 1], episode.action_values[:steps]]
        features = np.concatenate(parts, axis=1)
        yield np.full(steps, episode.seed), np.arange(1, steps + 1), features, episode.rewards[:steps]


def _alike(features: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of steps that are alike, in no number farther apart than 1: first of each, second of each."""
    features = features - features.mean(axis=0)
    squares = (features**2).sum(axis=1)
    distances = squares[:, None] + squares[None, :] - 2 * features @ features.T
    # Rounding aside, no pair that is alike is farther apart than this.
    most = features.shape[1] + 1e-9 * squares.max(initial=0.0)
    one, two = np.nonzero(np.triu(distances <= most, 1))
    step = max(1, -(-len(one) // MOST_PAIRS))
    one, two = one[::step], two[::step]
    alike = (np.abs(features[one] - features[two]) <= 1.0).all(axis=1)
    return one[alike], two[alike]
