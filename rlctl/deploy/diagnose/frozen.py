"""Sensors that do not change although they do in simulation."""

import dataclasses

import numpy as np

from rlctl.deploy.diagnose.signals import Array, LoggedSignals

_LONGER = 3.0  # than the longest time without a change in simulation
_LEAST_ROWS = 20


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


def find_frozen(signals: LoggedSignals, sound: LoggedSignals) -> list[Frozen]:
    """Return the frozen elements of each observation, those of a term together."""
    found = []
    for name in signals.sizes:
        usual = [_longest_run(column, sound.lengths)[0] for column in sound.term(name).T]
        runs = [_longest_run(column, signals.lengths) for column in signals.term(name).T]
        longest = max(sound.lengths)
        stuck = [
            index
            for index, ((rows, _), often) in enumerate(zip(runs, usual, strict=True))
            if often < longest / 2 and rows >= max(_LONGER * often, _LEAST_ROWS)
        ]
        if stuck:
            rows, first = runs[stuck[0]]
            # Those that often keep a value, such as a joint at its top speed, but here with the others.
            stuck = [index for index, run in enumerate(runs) if index in stuck or run == (rows, first)]
            value = float(signals.term(name)[first, stuck[0]])
            found.append(Frozen(name, tuple(stuck), value, first, rows))
    return found


def _longest_run(values: Array, lengths: tuple[int, ...]) -> tuple[int, int]:
    """Return how many rows of a segment have the same value at most, and the first of them."""
    same = np.concatenate([[False], np.diff(values) == 0])
    same[np.cumsum((0, *lengths[:-1]))] = False
    count = np.arange(len(values)) - np.maximum.accumulate(np.where(same, 0, np.arange(len(values))))
    last = int(count.argmax())
    return int(count[last]) + 1, last - int(count[last])
