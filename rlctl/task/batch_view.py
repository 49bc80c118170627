"""What one policy sees of the worlds of a `BatchTask`, as rows: the counterpart of `View` for one world."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.task.history import HistoryRows, Start
from rlctl.task.observation import ROUNDING, View

Worlds = NDArray[np.int64]


class RowFault(Exception):
    """An observation of one of the rows is wrong."""

    def __init__(self, message: str, row: int) -> None:
        super().__init__(message)
        self.row = row


class BatchView:
    """Selects columns, stacks histories and checks the result; `available` are the sizes of all columns by name."""

    def __init__(self, worlds: int, view: View, available: Mapping[str, int], start: Start) -> None:
        form = view.format
        self.size = sum(form.sizes.values())
        self._names, self._ends = list(form.sizes), np.cumsum([*form.sizes.values()])
        self._columns = None if list(available) == self._names else _list_columns(self._names, available)
        self._history = HistoryRows(worlds, form.frame_sizes, form.frames, start) if form.frames else None
        low, high = form.space.low, form.space.high
        self._bounds = (low, high) if np.isfinite(low).any() or np.isfinite(high).any() else None

    def begin(self, worlds: Worlds) -> None:
        """Begin the episodes of some worlds."""
        if self._history is not None:
            self._history.begin(worlds)

    def assemble(self, values: NDArray[np.float64], worlds: Worlds) -> NDArray[np.float32]:
        """Return the observations of some worlds, shape (k, size), from all columns of these; raises `RowFault`."""
        chosen = values if self._columns is None else values[:, self._columns]
        stacked = chosen if self._history is None else self._history.add(chosen, worlds)
        result: NDArray[np.float32] = stacked.astype(np.float32)
        bad = ~np.isfinite(result.sum(axis=1))
        if bad.any():
            row = int(bad.argmax())
            raise RowFault(f"observation {self._name_of((~np.isfinite(result[row])).argmax())!r} is not finite", row)
        return result if self._bounds is None else self._clip(result, *self._bounds)

    def _clip(self, values: NDArray[np.float32], low: Any, high: Any) -> NDArray[np.float32]:
        clipped: NDArray[np.float32] = np.minimum(np.maximum(values, low), high)
        far = np.abs(clipped - values) > ROUNDING
        if far.any():
            row, element = np.argwhere(far)[0]
            value = values[row, element]
            raise RowFault(f"observation {self._name_of(element)!r} is {value:g}, outside its bounds,", int(row))
        return clipped

    def _name_of(self, element: Any) -> str:
        return self._names[int(np.searchsorted(self._ends, element, side="right"))]


def _list_columns(names: Sequence[str], available: Mapping[str, int]) -> NDArray[np.int64]:
    ends = dict(zip(available, np.cumsum([*available.values()]).tolist(), strict=True))
    return np.concatenate([np.arange(ends[name] - available[name], ends[name]) for name in names])
