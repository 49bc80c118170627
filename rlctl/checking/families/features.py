"""RL110 and RL114: numbers in an observation that say nothing, or are left out."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.experiments import check
from rlctl.checking.families.rewards import WITH_SEARCH, require_rewarded
from rlctl.checking.finding import NotApplicable, NotJudged, RuleFinding, Severity, list_names
from rlctl.checking.leaves import Leaf
from rlctl.checking.records import Records

Numbers = NDArray[np.float64]

FEWEST_ROWS = 50
FEWEST_SEEDS = 3
MOST_NAMED = 8
NEAR = 0.05
"""Two steps are alike where each number of both observations is as near as this, in units of its standard deviation
over everything that was recorded."""
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


def _is_image(leaf: Leaf) -> bool:
    return len(leaf.shape) == 3 and (leaf.dtype == "uint8" or min(leaf.shape[0], leaf.shape[-1]) in (1, 3, 4))


@check("RL110", *WITH_SEARCH)
def _find_constant_elements(records: Records) -> Iterator[RuleFinding]:
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
            names += [f"{built.element(index, int(column))} ({float(rows[0, column]):.4g})" for column in constant]
    if names:
        yield RuleFinding(
            "RL110",
            f"{len(names)} of {total} elements of the observation never changed: {list_names(names, MOST_NAMED)}",
            {"value": len(names), "expected": 0, "elements": [name.partition(" (")[0] for name in names[:MOST_NAMED]]},
            Severity.WARNING if has_constant_leaf else Severity.INFO,
        )


def _constant(rows: Numbers, leaf: Leaf) -> NDArray[np.intp]:
    """Return what never changes and could; of whole numbers, such as flags, only if none of the leaf does."""
    low, high = np.ravel(np.asarray(leaf.low, np.float64)), np.ravel(np.asarray(leaf.high, np.float64))
    still = (rows == rows[0]).all(axis=0)
    if np.dtype(leaf.dtype).kind != "f" and not still.all():
        return np.zeros(0, np.intp)
    return np.flatnonzero(still & (low < high))


@dataclasses.dataclass(frozen=True)
class _StartStep:
    """One of the first steps of an episode."""

    seed: int
    number: int
    """1 is the first."""
    observations: Numbers
    """The ones before and after it, in units of what is near. Shape (2, elements)."""
    reward: float

    def is_alike(self, other: _StartStep) -> bool:
        """Say whether the observations of both are the same, nearly."""
        return bool((np.abs(self.observations - other.observations) <= 1.0).all())


@check("RL114", *WITH_SEARCH)
def find_hidden_goal(records: Records) -> Iterator[RuleFinding]:
    """Compare the rewards of steps with the zero action that look alike, of different episodes and of one."""
    rewards = np.concatenate([episode.rewards for episode in require_rewarded(records)])
    pairs = [(one, two) for one, two in itertools.combinations(_first_steps(records), 2) if one.is_alike(two)]
    across = [pair for pair in pairs if pair[0].seed != pair[1].seed]
    within = [pair for pair in pairs if pair[0].seed == pair[1].seed]  # where chance in the reward would show
    seeds = {step.seed for pair in across for step in pair}
    if len(across) < FEWEST_PAIRS or len(within) < FEWEST_PAIRS or len(seeds) < FEWEST_ALIKE_SEEDS:
        return  # no two episodes came to the same state
    different, same = (float(np.median([_apart(pair) for pair in group])) for group in (across, within))
    if different > LARGE_PART * float(rewards.std()) and different > TIMES * same:
        one, two = max(across, key=_apart)
        yield RuleFinding(
            "RL114",
            f"with {len(seeds)} seeds, steps that look alike have rewards {different:.3g} apart (median of "
            f"{len(across):,} pairs), within one episode {same:.2g}: {one.reward:.4g} and {two.reward:.4g}, say",
            {
                "seed": two.seed,
                "step": two.number,
                "value": two.reward,
                "expected": one.reward,
                "other_seed": one.seed,
                "other_step": one.number,
            },
        )


def _apart(pair: tuple[_StartStep, _StartStep]) -> float:
    return abs(pair[0].reward - pair[1].reward)


def _first_steps(records: Records) -> list[_StartStep]:
    """Return the steps of all starts, but those that end an episode."""
    leaves = records.require_built().leaves
    if not leaves or any(not leaf.supported or len(leaf.shape) == 3 for leaf in leaves):
        raise NotApplicable("a part of the observation is an image or cannot be compared")
    near = np.concatenate([_near(_rows(records, index)) for index in range(len(leaves))])
    steps = []
    for episode in records.role("starts"):
        series = [episode.observations.get(index) for index in range(len(leaves))]
        flat = [one.values.reshape(len(one.values), -1) for one in series if one is not None]
        if [len(one) for one in flat] == [episode.steps + 1] * len(leaves):
            scaled = np.nan_to_num(np.concatenate(flat, axis=1) / near)
            steps += [
                _StartStep(episode.seed, number, scaled[number - 1 : number + 1], float(episode.rewards[number - 1]))
                for number in range(1, episode.steps + 1 - (episode.ended in ("terminated", "both")))
            ]
    return steps


def _near(rows: Numbers) -> Numbers:
    """Return how near two values of each element are that count as alike."""
    rows = np.where(np.isfinite(rows), rows, 0.0)
    near = NEAR * rows.std(axis=0)
    is_whole = (rows == np.round(rows)).all(axis=0)  # places and kinds are alike only if they are equal
    near[is_whole] = np.minimum(near[is_whole], 0.5)
    return np.where(near > 0, near, 1.0)
