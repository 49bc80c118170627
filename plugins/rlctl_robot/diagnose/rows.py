"""Chooses the rows of a log that tell most: those in which the robot moves."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from rlctl_robot.diagnose.candidates import TermStatistics
from rlctl_robot.diagnose.signals import Array, LoggedSignals

_APART = 8  # rows before and after, between which motion is measured
_MOST_MOTION = 2.0  # of an element, in standard deviations in simulation: a wrong unit must not decide alone
_REST = 0.02  # motion of a row in which nothing moves, so that a robot that stands still has rows too


@dataclasses.dataclass(frozen=True, eq=False)
class ChosenRows:
    """Rows of a log, more of them where more moves."""

    rows: Array
    stands_for: float  # rows of an always equally moving robot that say as much as those they were chosen from


def measure_motion(signals: LoggedSignals, rows: Array, statistics: Mapping[str, TermStatistics]) -> Array:
    """Return how far the observations move around each row, in standard deviations, shape (rows,)."""
    std = np.concatenate([statistics[name].std for name in signals.sizes])
    change = np.abs(signals.observations[rows + _APART] - signals.observations[rows - _APART]) / std
    motion: Array = _REST + np.minimum(change, _MOST_MOTION).mean(axis=1)
    return motion


def choose_rows(signals: LoggedSignals, rows: Array, statistics: Mapping[str, TermStatistics], most: int) -> ChosenRows:
    """Choose at most `most` of `rows`, spread evenly over the way that the robot moved."""
    motion = measure_motion(signals, rows, statistics)
    stands_for = float(motion.sum() ** 2 / np.square(motion).sum())
    if len(rows) <= most:
        return ChosenRows(rows, stands_for)
    way = np.cumsum(motion)
    chosen = np.searchsorted(way, (np.arange(most) + 0.5) / most * way[-1])
    return ChosenRows(rows[np.unique(chosen)], stands_for)
