"""The newest steps that a student has played, each with the action of its teacher."""

from collections.abc import Mapping

import numpy as np

from rlctl.training.snapshot import Tensors

_MOST_BYTES = 64 * 2**20
_PREFIX, _NEXT = "labelled/rows/", "labelled/next"


class LabelledSteps:
    """A ring of rows by name; it grows up to 64 MiB, then the oldest rows are replaced."""

    def __init__(self) -> None:
        self._rows: Tensors = {}
        self._next = 0  # where the next rows are written

    def __len__(self) -> int:
        return len(next(iter(self._rows.values()), ()))

    def add(self, rows: Tensors) -> None:
        """Add rows, arrays of shape (n, ...) by name; n is the same in every call."""
        added = len(next(iter(rows.values())))
        most = max(1, _MOST_BYTES // max(1, sum(values.nbytes for values in rows.values()))) * added
        if len(self) < most:
            self._rows = {
                name: np.concatenate([self._rows[name], values]) if self._rows else values.copy()
                for name, values in rows.items()
            }
            return
        for name, values in rows.items():
            self._rows[name][self._next : self._next + added] = values
        self._next = (self._next + added) % most

    def sample(self, rng: np.random.Generator, count: int) -> Tensors:
        """Return random rows, shape (count, ...) by name."""
        chosen = rng.integers(len(self), size=count)
        return {name: values[chosen] for name, values in self._rows.items()}

    def take(self) -> Tensors:
        """Return the state as tensors."""
        return {_PREFIX + name: values for name, values in self._rows.items()} | {_NEXT: np.array(self._next)}

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Restore the state that `take` returned."""
        self._next = int(tensors[_NEXT])
        self._rows = {
            name.removeprefix(_PREFIX): values.copy() for name, values in tensors.items() if name.startswith(_PREFIX)
        }
