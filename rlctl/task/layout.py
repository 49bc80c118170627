"""`Layout`: which element of a row belongs to which name."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np


class Layout:
    """Names one after the other in a row; `sizes` has the number of elements of each."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self.sizes = dict(sizes)
        self.size = sum(sizes.values())
        self.columns: dict[str, slice] = {}
        """Place of each name in a row."""
        start = 0
        for name, size in sizes.items():
            self.columns[name] = slice(start, start + size)
            start += size

    def find_name(self, element: int) -> str:
        """Return the name to which an element of a row belongs."""
        return next(name for name, columns in self.columns.items() if element < columns.stop)

    def split(self, rows: Any) -> dict[str, Any]:
        """Return the columns of each name, of an array of shape (..., size); they share memory with it."""
        return {name: rows[..., columns] for name, columns in self.columns.items()}

    def list_columns(self, names: Iterable[str]) -> Any:
        """Return the indices of the elements of some names, in the order of `names`."""
        return np.concatenate([np.arange(self.size)[self.columns[name]] for name in names])
