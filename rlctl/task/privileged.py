"""What only a critic sees in a training: what the task names, and the values that its events drew."""

from collections.abc import Iterable, Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import RecipeError, TaskError, short_repr
from rlctl.task.layout import Layout
from rlctl.task.returned import not_by_name

PrivilegedRow = NDArray[np.float32]
Drawn = Mapping[str, Mapping[str, float]]
"""Per event the values that it drew, by name."""


class CriticSight:
    """Names and sizes of what only the critic sees, and its assembly into rows of shape (size,).

    `first` is an example of what the task names, `drawn` of the values of its events. An event that has not acted yet
    in an episode, such as a push, counts as 0.
    """

    def __init__(self, task: str, first: Mapping[str, Any], drawn: Drawn) -> None:
        self._task = task
        self._of_task = {name: int(np.size(value)) for name, value in first.items()}
        self._of_events = {event: list(values) for event, values in drawn.items() if values}
        self.sizes = self._of_task | {f"events/{event}": len(names) for event, names in self._of_events.items()}
        """Number of elements by name, in the order of a row."""
        if empty := [name for name, size in self.sizes.items() if size == 0]:
            raise TaskError(f"{task}: privileged() returned {empty[0]!r} empty")
        self._columns = Layout(self.sizes).columns
        self.size = sum(self.sizes.values())

    @classmethod
    def of(cls, name: str, first: Any, drawn: Drawn, *, task: bool, events: bool) -> Self:
        """Return the format of a task and of its events, or of one of them; raises `RecipeError` if it is empty."""
        if not isinstance(first, dict):
            raise not_by_name(name, "privileged", first)
        result = cls(name, first if task else {}, drawn if events else {})
        if not result.size:
            raise RecipeError(
                f"privileged: a critic of {name} would see no more than the actor: the task has no privileged(), and "
                "no event acts; leave the key out, or enable events: randomize: true"
            )
        return result

    def read_task(self, task: Any) -> dict[str, Any]:
        """Return what the task names now."""
        return task.privileged() if self._of_task else {}

    def write_task(self, rows: PrivilegedRow, parts: Mapping[str, Any]) -> None:
        """Write what the task names into `rows`, shape (..., size); raises `TaskError` if it does not fit."""
        if not isinstance(parts, dict) or list(parts) != list(self._of_task):
            names = list(parts) if isinstance(parts, dict) else parts
            raise TaskError(f"{self._task}: privileged() returned {short_repr(names)}, at first {list(self._of_task)}")
        for name, size in self._of_task.items():
            values = np.asarray(parts[name], np.float32).reshape(*rows.shape[:-1], -1)
            if values.shape[-1] != size:
                raise TaskError(
                    f"{self._task}: privileged()[{name!r}] has {values.shape[-1]} elements, at first it had {size}"
                )
            rows[..., self._columns[name]] = values

    def find_fault(self, row: PrivilegedRow) -> str:
        """Return the name of an element that is not finite; empty if there is none."""
        bad = ~np.isfinite(row)
        return next((name for name, columns in self._columns.items() if bad[columns].any()), "")

    def write_events(self, row: PrivilegedRow, drawn: Drawn) -> None:
        """Write the values of the events in `drawn` into a row, shape (size,)."""
        for event, names in self._of_events.items():
            if event in drawn:
                row[self._columns[f"events/{event}"]] = self._read(event, names, drawn[event])

    def _read(self, event: str, names: Iterable[str], drawn: Mapping[str, float]) -> list[float]:
        try:
            return [drawn[name] for name in names]
        except KeyError as error:
            raise TaskError(
                f"{self._task}: events.{event} drew {list(drawn)}, at first {list(names)}: a critic that sees {error} "
                "needs the same names in every episode; privileged.events: false leaves the events out"
            ) from None
