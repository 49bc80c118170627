"""The newest steps that a student has played, each with the action of its teacher."""

from collections.abc import Mapping

import numpy as np

from rlctl.training.snapshot import Tensors

MOST_BYTES, MOST_BYTES_OF_PICTURES = 64 * 2**20, 2**30
_PREFIX, _NEXT = "labelled/rows/", "labelled/next"


class LabelledSteps:
    """A ring of rows by name, in the types in which they are added: pictures are bytes.

    It grows up to 64 MiB, with pictures up to 1 GiB, then the oldest rows are replaced.
    """

    def __init__(self) -> None:
        self._rows: Tensors = {}  # as long as the ring may get; the system provides memory when it is written
        self._count = 0  # rows that are written
        self._next = 0  # where the next rows are written

    def __len__(self) -> int:
        return self._count

    def add(self, rows: Tensors) -> None:
        """Add rows, arrays of shape (n, ...) by name; n is the same in every call."""
        added = len(next(iter(rows.values())))
        if not self._rows:
            most = _count_most(rows)
            self._rows = {name: np.zeros((most, *values.shape[1:]), values.dtype) for name, values in rows.items()}
        most = len(next(iter(self._rows.values())))
        for name, values in rows.items():
            self._rows[name][self._next : self._next + added] = values
        self._count = max(self._count, self._next + added)
        self._next = (self._next + added) % most

    def sample(self, rng: np.random.Generator, count: int) -> Tensors:
        """Return random rows, shape (count, ...) by name."""
        chosen = rng.integers(self._count, size=count)
        return {name: values[chosen] for name, values in self._rows.items()}

    def take(self) -> Tensors:
        """Return the state as tensors."""
        written = {_PREFIX + name: values[: self._count] for name, values in self._rows.items()}
        return written | {_NEXT: np.array([self._next, len(next(iter(self._rows.values()), ()))])}

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """Restore the state that `take` returned."""
        self._next, most = (int(number) for number in tensors[_NEXT])
        self._rows = {}
        for name, values in tensors.items():
            if name.startswith(_PREFIX):
                self._count = len(values)
                ring = self._rows[name.removeprefix(_PREFIX)] = np.zeros((most, *values.shape[1:]), values.dtype)
                ring[: len(values)] = values


def _count_most(rows: Tensors) -> int:
    """Return how many rows fit, a multiple of those that are added together."""
    has_pictures = any(values.dtype == np.uint8 and values.ndim == 4 for values in rows.values())
    bytes_of_all = MOST_BYTES_OF_PICTURES if has_pictures else MOST_BYTES
    added = len(next(iter(rows.values())))
    bytes_of_added = sum(values.nbytes for values in rows.values())
    return max(1, bytes_of_all // max(1, bytes_of_added)) * added
