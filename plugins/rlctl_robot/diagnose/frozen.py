"""Sensors that do not change although they do in simulation."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl_robot.diagnose.signals import Array, LoggedSignals

_LONGER = 3.0  # than the longest motion of the others without a change in simulation
_LONGER_AT_END = 10.0  # the same at an end of the range, where contacts and saturated actions stay
_LEAST_ROWS = 20
_LEAST_ROWS_AT_END = 200  # of a value that an end stop or a top speed could be
_NEAR_END = 0.02  # of the range of values: a joint goes a little beyond its end stop
_ECHO = 1e-4  # median difference of the last action and the observation that repeats it
_MOST_MOTION = 2.0  # of an element in a row, in standard deviations: a wrong unit must not decide alone
_LEAST_MOTION = 0.05  # of the standard deviations in simulation


@dataclasses.dataclass(frozen=True)
class Frozen:
    """Elements of an observation that keep their values from a row on."""

    term: str
    elements: tuple[int, ...]
    value: float  # of the first of the elements
    first_row: int  # in the log, from 0
    rows: int

    def describe(self, size: int) -> str:
        """Return a line such as `hand: element 2 is frozen at 0.31 from row 40 on, for 200 rows`."""
        which = "all elements" if len(self.elements) == size and size > 1 else f"element {self.elements[0]}"
        if 1 < len(self.elements) < size:
            which = f"elements {', '.join(str(index) for index in self.elements)}"
        verb = "are" if len(self.elements) > 1 else "is"
        at = f" at {self.value:.4g}" if len(self.elements) == 1 else ""
        return f"{self.term}: {which} {verb} frozen{at} from row {self.first_row} on, for {self.rows} rows"


def find_frozen(signals: LoggedSignals, references: Sequence[LoggedSignals]) -> list[Frozen]:
    """Return the elements of each observation that are frozen to the end of a segment, those of a term together."""
    found = []
    ends = np.cumsum(signals.lengths).tolist()
    for name in signals.sizes:
        motion = _measure_motion(signals, references[0], name)
        usual = [_measure_motion(one, references[0], name) for one in references]
        runs = [_longest_run(column, signals.lengths, motion) for column in signals.term(name).T]
        stuck = [
            index
            for index, run in enumerate(runs)
            if run.first + run.rows in ends
            and run.rows >= (_LEAST_ROWS_AT_END if _reaches_end(signals, name, index, run.first) else _LEAST_ROWS)
            and _moves(signals, references[0], name, slice(run.first, run.first + run.rows))
            and not _repeats_constant_action(
                signals, references[0], name, index, slice(run.first, run.first + run.rows - 1)
            )
            and _is_longer(run, references, usual, name, index, signals.term(name)[run.first, index])
        ]
        if stuck:
            run = runs[stuck[0]]
            # Those that often keep a value, such as a joint at its top speed, but here with the others.
            stuck = [index for index, other in enumerate(runs) if index in stuck or other == run]
            value = float(signals.term(name)[run.first, stuck[0]])
            found.append(Frozen(name, tuple(stuck), value, run.first, run.rows))
    return found


def _measure_motion(signals: LoggedSignals, sound: LoggedSignals, name: str) -> Array:
    """Return how far the other observations move from the row before, in standard deviations, shape (T,).

    At rest all sensors of a simulation keep their values.
    """
    others = np.delete(np.arange(signals.observations.shape[1]), np.r_[signals.slices[name]])
    std = sound.observations[:, others].std(axis=0)
    others, std = others[std > 0], std[std > 0]
    if not len(others):
        return np.ones(len(signals.observations))
    change = np.abs(np.diff(signals.observations[:, others], axis=0)) / std
    return np.append(0.0, np.minimum(change, _MOST_MOTION).mean(axis=1))


def _moves(signals: LoggedSignals, sound: LoggedSignals, name: str, rows: slice) -> bool:
    """Return whether the other observations change in these rows: a robot that lies still has no frozen sensors."""
    others = [other for other in signals.sizes if other != name]
    ratios = [
        signals.term(other)[rows].std(axis=0) / np.maximum(sound.term(other).std(axis=0), 1e-9) for other in others
    ]
    return not ratios or bool(np.median(np.concatenate(ratios)) > _LEAST_MOTION)


def _repeats_constant_action(signals: LoggedSignals, sound: LoggedSignals, name: str, index: int, rows: slice) -> bool:
    """Return whether an element is that of the last action, and the action itself does not change."""
    if signals.sizes[name] != signals.actions.shape[1]:
        return False
    later = sound.inner_rows(1)
    is_last = np.median(np.abs(sound.term(name)[later, index] - sound.actions[later - 1, index])) < _ECHO
    return bool(is_last and np.ptp(signals.actions[rows, index]) == 0)


def _reaches_end(signals: LoggedSignals, name: str, index: int, first: int) -> bool:
    """Return whether an element moved to its least or greatest value of the segment: perhaps an end stop."""
    segment = int(np.searchsorted(np.cumsum(signals.lengths), first, side="right"))
    start = signals.starts[segment]
    values = signals.term(name)[start : start + signals.lengths[segment], index]
    near = _NEAR_END * np.ptp(values)
    return first > start and not values.min() + near < values[first - start] < values.max() - near


def _is_longer(
    run: "_Run", references: Sequence[LoggedSignals], motion: Sequence[Array], name: str, index: int, value: float
) -> bool:
    """Return whether a value stays for more rows, and during more motion, than in simulation."""
    columns = [signals.term(name)[:, index] for signals in references]
    usual = [
        _longest_run(column, one.lengths, some) for column, one, some in zip(columns, references, motion, strict=True)
    ]
    usual_rows = max(
        _longest_run(column, one.lengths, np.ones(len(column))).rows
        for column, one in zip(columns, references, strict=True)
    )
    most = max(
        part.sum()
        for one, some in zip(references, motion, strict=True)
        for part in np.split(some, np.cumsum(one.lengths)[:-1])
    )
    usual_motion = max(one.motion for one in usual)
    if usual_motion >= most / 2:  # it often does not change at all
        return False
    low, high = min(column.min() for column in columns), max(column.max() for column in columns)
    is_inside = low + 1e-6 < value < high - 1e-6
    factor = _LONGER if is_inside else _LONGER_AT_END
    return run.rows > factor * usual_rows and run.motion > factor * usual_motion


@dataclasses.dataclass(frozen=True)
class _Run:
    rows: int
    first: int
    motion: float  # of the other observations in these rows


def _longest_run(values: Array, lengths: tuple[int, ...], motion: Array) -> _Run:
    """Return the rows of a segment that have the same value while the others move farthest."""
    begins = np.append(True, np.diff(values) != 0)
    begins[np.cumsum((0, *lengths[:-1]))] = True
    number = np.cumsum(begins) - 1
    moved = np.bincount(number, weights=np.where(begins, 0.0, motion))
    longest = int(moved.argmax())
    return _Run(int((number == longest).sum()), int(np.searchsorted(number, longest)), float(moved[longest]))
