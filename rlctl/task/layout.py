"""`Layout`: which element of a row belongs to which name, and which of them are older values of a history."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True)
class Part:
    """Where the elements of a name are."""

    name: str
    size: int  # elements of one value
    frames: int  # number of last values, oldest first
    start: int  # place in a row
    newest: int  # place among the newest values of all names

    @property
    def stop(self) -> int:
        """The place after its last element."""
        return self.start + self.size * self.frames


class Layout:
    """Names one after the other in a row.

    `sizes` has the number of elements of each, those of all its `frames` if it is a history.
    """

    def __init__(self, sizes: Mapping[str, int], frames: Mapping[str, int] | None = None) -> None:
        self.sizes = dict(sizes)
        self.parts: list[Part] = []
        start = newest = 0
        for name, size in sizes.items():
            count = (frames or {}).get(name, 1)
            self.parts.append(Part(name, size // count, count, start, newest))
            start, newest = start + size, newest + size // count
        self.size, self.newest_size = start, newest
        self.columns: dict[str, slice] = {part.name: slice(part.start, part.stop) for part in self.parts}
        """Place of each name in a row."""

    def find_name(self, element: int) -> str:
        """Return the name to which an element of a row belongs."""
        return next(name for name, columns in self.columns.items() if element < columns.stop)

    def split(self, rows: Any) -> dict[str, Any]:
        """Return the columns of each name, of an array of shape (..., size); they share memory with it."""
        return {name: rows[..., columns] for name, columns in self.columns.items()}

    def list_columns(self, names: Iterable[str]) -> Any:
        """Return the indices of the elements of some names, in the order of `names`."""
        return np.concatenate([np.arange(self.size)[self.columns[name]] for name in names])

    def find_sources(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return of each element which of the newest values it is, and how many steps ago; both of shape (size,)."""
        sources, ages = np.zeros(self.size, np.int64), np.zeros(self.size, np.int64)
        for part in self.parts:
            elements = np.arange(part.size * part.frames)
            sources[part.start : part.stop] = part.newest + elements % part.size
            ages[part.start : part.stop] = part.frames - 1 - elements // part.size
        return sources, ages
