"""Sensors that do not change although they do in simulation."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rlctl.deploy.diagnose.signals import Array, LoggedSignals

_LONGER = 3.0  # than the longest time without a change in simulation
_LONGER_AT_END = 10.0  # the same at an end of the range, where contacts and saturated actions stay
_LEAST_ROWS = 20
_LEAST_CHANGING = 0.25  # of the other elements, in a row in which something moves
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
        moving = _find_moving(signals, references[0], name)
        usual_moving = [_find_moving(one, references[0], name) for one in references]
        runs = [_longest_run(column, signals.lengths, moving) for column in signals.term(name).T]
        stuck = [
            index
            for index, run in enumerate(runs)
            if run.first + run.rows in ends
            and _moves(signals, references[0], name, slice(run.first, run.first + run.rows))
            and not _repeats_constant_action(signals, name, index, slice(run.first, run.first + run.rows - 1))
            and run.moving
            >= max(
                _LEAST_ROWS,
                _count_least(references, usual_moving, name, index, signals.term(name)[run.first, index]),
            )
        ]
        if stuck:
            run = runs[stuck[0]]
            # Those that often keep a value, such as a joint at its top speed, but here with the others.
            stuck = [index for index, other in enumerate(runs) if index in stuck or other == run]
            value = float(signals.term(name)[run.first, stuck[0]])
            found.append(Frozen(name, tuple(stuck), value, run.first, run.rows))
    return found


def _find_moving(signals: LoggedSignals, sound: LoggedSignals, name: str) -> Array:
    """Return in which rows the other observations change: at rest, all sensors of a simulation keep their values."""
    others = np.delete(np.arange(signals.observations.shape[1]), np.r_[signals.slices[name]])
    others = others[np.ptp(sound.observations[:, others], axis=0) > 0]
    if not len(others):
        return np.ones(len(signals.observations), bool)
    changed = np.diff(signals.observations[:, others], axis=0) != 0
    return np.append(True, changed.mean(axis=1) >= _LEAST_CHANGING)


def _moves(signals: LoggedSignals, sound: LoggedSignals, name: str, rows: slice) -> bool:
    """Return whether the other observations change in these rows: a robot that lies still has no frozen sensors."""
    others = [other for other in signals.sizes if other != name]
    ratios = [
        signals.term(other)[rows].std(axis=0) / np.maximum(sound.term(other).std(axis=0), 1e-9) for other in others
    ]
    return not ratios or bool(np.median(np.concatenate(ratios)) > _LEAST_MOTION)


def _repeats_constant_action(signals: LoggedSignals, name: str, index: int, rows: slice) -> bool:
    """Return whether an element is that of the last action, and the action itself does not change."""
    if signals.sizes[name] != signals.actions.shape[1]:
        return False
    actions = signals.actions[rows, index]
    return bool(np.ptp(actions) == 0 and signals.term(name)[rows.stop, index] == actions[-1])


def _count_least(
    references: Sequence[LoggedSignals], moving: Sequence[Array], name: str, index: int, value: float
) -> float:
    """Return for how many rows an element must keep a value: never, if it often does in simulation."""
    columns = [signals.term(name)[:, index] for signals in references]
    usual = max(
        _longest_run(column, one.lengths, some).moving
        for column, one, some in zip(columns, references, moving, strict=True)
    )
    if usual >= max(max(one.lengths) for one in references) / 2:
        return np.inf
    low, high = min(column.min() for column in columns), max(column.max() for column in columns)
    is_inside = low + 1e-6 < value < high - 1e-6
    return (_LONGER if is_inside else _LONGER_AT_END) * usual


@dataclasses.dataclass(frozen=True)
class _Run:
    rows: int
    first: int
    moving: int  # rows of these in which the other observations change


def _longest_run(values: Array, lengths: tuple[int, ...], moving: Array) -> _Run:
    """Return the rows of a segment that have the same value while the others change for the longest time."""
    begins = np.append(True, np.diff(values) != 0)
    begins[np.cumsum((0, *lengths[:-1]))] = True
    number = np.cumsum(begins) - 1
    counts = np.bincount(number, weights=moving | begins)
    longest = int(counts.argmax())
    return _Run(int((number == longest).sum()), int(np.searchsorted(number, longest)), int(counts[longest]))
