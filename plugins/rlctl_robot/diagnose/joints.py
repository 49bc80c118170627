"""Which explanation of a log the simulation of its robot prefers, among them that a driver exchanges joints."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from rlctl_robot.diagnose.correction import Correction, correct
from rlctl_robot.diagnose.physics import Physics
from rlctl_robot.diagnose.search import LEAST_SHARE, Found
from rlctl_robot.diagnose.signals import Array, LoggedSignals

FEWEST_ROWS = 36
"""Rows without a gap that the simulation needs: so many of each of `_FIRST_PARTS` for all mistakes of the joints."""
_FIRST_PARTS = 2
_ROWS, _PARTS = 60, 10  # for the best of them
_BEST = 8  # mistakes of the joints that are compared in more rows
_LEAST_DEVIATION = 5.0  # standard errors by which a mistake of the joints must be better than without it
_WORSE = 3.0  # standard errors by which the log is more plausible without a correction that is then removed
_ALIKE = 2.0  # standard errors that two explanations must differ by to be told apart
_MOST_EVIDENCE = 1e3  # [nats]


@dataclasses.dataclass(frozen=True)
class Judgement:
    """What the simulation prefers, and how well it then predicts the log."""

    found: tuple[Found, ...]
    times_usual: float  # loss relative to the largest of a sound robot
    times_usual_before: float  # the same of the log without corrections
    adds_mistake: bool = False  # whether it found a mistake of the joints


def judge(
    physics: Physics, signals: LoggedSignals, found: Sequence[Found], mistakes: Sequence[Correction]
) -> Judgement | None:
    """Return the corrections that make the simulation follow the log; None if no part of the log is long enough.

    `found` is what the relations of signals say, `mistakes` are those of the joints, by their driver or in one term, at
    most one of which is added. What the simulation contradicts is removed.
    """
    corrections = [one.correction for one in found]
    subsets = [
        list(some) for count in range(len(corrections) + 1) for some in itertools.combinations(corrections, count)
    ]
    bases = [[], *([one] for one in corrections[:1])]
    of_joints = [[*base, mistake] for base in bases for mistake in mistakes]
    first = physics.choose_starts(signals, FEWEST_ROWS, _FIRST_PARTS)
    if not first:
        return None
    losses = _measure(physics, signals, of_joints, first, FEWEST_ROWS).mean(axis=1)
    best = [of_joints[index] for index in np.argsort(losses)[:_BEST]]
    explanations = [*subsets, *best]
    rows, starts = _ROWS, physics.choose_starts(signals, _ROWS, _PARTS)
    if not starts:
        rows, starts = FEWEST_ROWS, physics.choose_starts(signals, FEWEST_ROWS, _PARTS)
    blocks = _measure(physics, signals, explanations, starts, rows)
    plain = _choose_plain(blocks[: len(subsets)], subsets)
    uncorrected = float(blocks[0].mean()) / physics.usual_loss  # the first subset is empty
    chosen = _choose_joints(blocks, plain, len(subsets), explanations)
    if chosen is None:
        kept = tuple(one for one in found if one.correction in subsets[plain])
        return Judgement(kept, float(blocks[plain].mean()) / physics.usual_loss, uncorrected)
    mistake = explanations[chosen][-1]
    before = int(np.flatnonzero([some == explanations[chosen][:-1] for some in subsets])[0])
    deviation, share = _compare(blocks[before], blocks[chosen])
    alike = [
        explanations[index][-1]
        for index in range(len(subsets), len(explanations))
        if index != chosen and _compare(blocks[index], blocks[chosen])[0] < _ALIKE
    ]
    evidence = min(0.5 * deviation**2, _MOST_EVIDENCE)
    kept = tuple(one for one in found if one.correction in explanations[chosen])
    first_found = Found(mistake, evidence, share, tuple(dict.fromkeys(alike))[:2])
    corrected = float(blocks[chosen].mean()) / physics.usual_loss
    return Judgement((first_found, *kept), corrected, uncorrected, adds_mistake=True)


def _measure(
    physics: Physics,
    signals: LoggedSignals,
    explanations: Sequence[Sequence[Correction]],
    starts: Sequence[int],
    rows: int,
) -> Array:
    logs = [correct(signals, some, on_robot=True) for some in explanations]
    return physics.compute_losses(logs, starts, rows)


def _choose_plain(blocks: Array, subsets: Sequence[Sequence[Correction]]) -> int:
    """Return which of the corrections found before stay: all, unless the log is clearly more plausible without some."""
    everything = len(subsets) - 1
    best = min(range(len(subsets)), key=lambda index: float(blocks[index].mean()))
    return best if _compare(blocks[everything], blocks[best])[0] >= _WORSE else everything


def _choose_joints(blocks: Array, plain: int, first: int, explanations: Sequence[Sequence[Correction]]) -> int | None:
    """Return the best explanation with a mistake of the joints if it is clearly better than all without."""
    means = blocks.mean(axis=1)
    rival = min(range(first), key=lambda index: float(means[index]))
    good = [
        index
        for index in range(first, len(blocks))
        for deviation, share in [_compare(blocks[rival], blocks[index])]
        if deviation >= _LEAST_DEVIATION and share >= LEAST_SHARE
    ]
    if not good:
        return None
    best = min(good, key=lambda index: float(means[index]))
    # One mistake is enough where a second one does not clearly add to it.
    single = [index for index in good if len(explanations[index]) < len(explanations[best])]
    alike = [index for index in single if _compare(blocks[index], blocks[best])[0] < _LEAST_DEVIATION]
    return min(alike, key=lambda index: float(means[index]), default=best)


def _compare(before: Array, after: Array) -> tuple[float, float]:
    """Return by how many standard errors the losses of blocks are lower after, and by which part of them."""
    gain = before - after
    error = float(gain.std(ddof=1)) / np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    deviation = float(gain.mean()) / max(error, 1e-9)
    return deviation, float(gain.mean()) / max(float(before.mean()), 1e-9)
