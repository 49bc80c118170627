"""RL114: an observation that leaves out what the reward depends on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.experiment import check
from rlctl.check_env.finding import Finding, NotApplicable
from rlctl.check_env.messages import Trajectory
from rlctl.check_env.records import Records
from rlctl.check_env.rewarded import WITH_SEARCH, require_rewarded

Numbers = NDArray[np.float64]

NEAR, NEAR_ACTION = 0.05, 0.25
"""Two steps are alike where each number of both observations is as near as this, and each of the actions (much of which
the observations show already), in units of its standard deviation over everything that was recorded."""
MOST_STEPS = 2_000
"""Steps that are compared, each with each."""
MOST_PAIRS = 20_000
FEWEST_PAIRS = 30
FEWEST_SEEDS = 4
"""Seeds among which alike steps are found: with fewer it may be something special of one episode."""
LARGE_PART = 0.25
"""How different the rewards of alike steps of different episodes have to be, against those of all steps (standard
deviation): half of the pairs at least."""
TIMES = 10.0
"""How much larger that has to be than between alike steps of one episode, where a goal is the same but noise is not."""


@dataclasses.dataclass(frozen=True)
class _Steps:
    """Steps of all kinds of episodes."""

    seeds: NDArray[np.int64]
    numbers: NDArray[np.int64]
    """Which step of its episode each is."""
    features: Numbers
    """Observation before, observation after, action; in units of what is near. Shape (n, elements)."""
    rewards: Numbers


@check("RL114", *WITH_SEARCH)
def find_hidden_goal(records: Records) -> Iterator[Finding]:
    steps = _steps(records, require_rewarded(records))
    one, two = _alike(steps.features)
    differences = np.abs(steps.rewards[one] - steps.rewards[two])
    across = steps.seeds[one] != steps.seeds[two]
    # Of one episode, recorded twice perhaps, but at different times: chance in the reward would show.
    within = ~across & (steps.numbers[one] != steps.numbers[two])
    seeds = len(np.unique(np.concatenate([steps.seeds[one[across]], steps.seeds[two[across]]])))
    if across.sum() < FEWEST_PAIRS or within.sum() < FEWEST_PAIRS or seeds < FEWEST_SEEDS:
        return  # no two episodes came to the same state
    different, same = float(np.median(differences[across])), float(np.median(differences[within]))
    if different > LARGE_PART * float(steps.rewards.std()) and different > TIMES * same:
        pair = np.flatnonzero(across)[int(differences[across].argmax())]
        first, second = int(one[pair]), int(two[pair])
        yield Finding(
            "RL114",
            f"with {seeds} seeds, steps that look alike have rewards {different:.3g} apart (median of {across.sum():,} "
            f"pairs), within one episode {same:.2g}: {steps.rewards[first]:.4g} and {steps.rewards[second]:.4g}, say",
            {
                "seed": int(steps.seeds[second]),
                "step": int(steps.numbers[second]),
                "value": float(steps.rewards[second]),
                "expected": float(steps.rewards[first]),
                "other_seed": int(steps.seeds[first]),
                "other_step": int(steps.numbers[first]),
            },
        )


def _steps(records: Records, episodes: list[Trajectory]) -> _Steps:
    leaves = records.require_built().leaves
    if not leaves or any(not leaf.supported for leaf in leaves):
        raise NotApplicable("a part of the observation cannot be compared")
    if any(len(leaf.shape) == 3 for leaf in leaves):
        raise NotApplicable("images are not compared")
    parts = [part for each in episodes if (part := _steps_of(each, len(leaves))) is not None]
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
    return _Steps(seeds[chosen], numbers[chosen], scaled, rewards[chosen])


def _steps_of(episode: Trajectory, leaves: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Numbers, Numbers] | None:
    """Return seeds, numbers, features and rewards of an episode's steps; a last one that ends is left out."""
    steps = episode.steps - (episode.ended in ("terminated", "both", "raised"))
    series = [episode.observations.get(index) for index in range(leaves)]
    if steps < 1 or any(each is None or len(each.steps) != episode.steps + 1 for each in series):
        return None
    flat = [each.values.reshape(episode.steps + 1, -1).astype(np.float64) for each in series if each is not None]
    observations = np.concatenate(flat, axis=1)
    if not np.isfinite(observations).all():
        return None
    features = np.concatenate(
        [observations[:steps], observations[1 : steps + 1], episode.action_values[:steps]], axis=1
    )
    return np.full(steps, episode.seed), np.arange(1, steps + 1), features, episode.rewards[:steps]


def _alike(features: Numbers) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
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
