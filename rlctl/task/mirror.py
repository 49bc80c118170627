"""Mirror symmetry of a robot: what its left side does is what its right side does, with some signs changed."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import TaskError, check_name

ACTION = "action"
"""The name of the action in a declaration, beside those of the observations."""
EVENTS = "events/"
"""The names of what events drew begin with it."""

Declaration = Mapping[str, Sequence[int]]
"""Per name of an observation, and for `action`: which element is each element of the mirrored array, counted from 1,
with its sign. `(-1, 2, -3)` changes the signs of the first and the third one, `(2, 1)` exchanges two."""


class Mirror:
    """Mirrors arrays along their last axis; `places` has an element and its sign for each, as in a declaration."""

    def __init__(self, places: Sequence[int]) -> None:
        self._index = np.abs(places) - 1
        self._sign = np.sign(places).astype(np.float32)

    def __call__(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the mirrored values, of the same shape."""
        mirrored: NDArray[Any] = values.take(self._index, axis=-1)
        mirrored *= self._sign
        return mirrored


def join_places(declared: Declaration, sizes: Iterable[tuple[str, int]]) -> tuple[int, ...]:
    """Return the places of several arrays one after the other, as a flat observation has them; `sizes` by name.

    What events drew is unchanged unless it is declared, as a mass is. Raises `TaskError` for a missing or an invalid
    entry.
    """
    joined: list[int] = []
    for name, size in sizes:
        if name not in declared and not name.startswith(EVENTS):
            raise TaskError(f"mirror: {name!r} is missing; each observation and the action need an entry")
        places = list(declared.get(name, range(1, size + 1)))
        if sorted(map(abs, places)) != list(range(1, size + 1)):
            raise TaskError(
                f"mirror: {name!r} has {size} elements, so each number from 1 to {size} is needed once, with a sign; "
                f"got {places}"
            )
        first = len(joined)
        joined += [place + first if place > 0 else place - first for place in places]
    return tuple(joined)


def check_declaration(task: str, declared: Declaration, sizes: Mapping[str, int], others: Iterable[str]) -> None:
    """Raise `TaskError` if a declaration does not fit the observations and the action, whose sizes these are.

    `others` are names that it may have too, of what only a critic sees.
    """
    if not declared:
        return
    join_places(declared, sizes.items())
    for name in declared:
        if not name.startswith(EVENTS):
            check_name(name, [*sizes, *others], f"{task}: mirror: nothing is called", TaskError, listed="There are")
