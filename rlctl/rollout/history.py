"""The actions of the episodes that environments are in: what it takes to replay them up to now."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_BYTES = 2**28
"""Memory for actions, 256 MB, of which each environment has its part. A longer episode cannot be replayed."""


class ActionHistory:
    """Stores the actions of each environment's running episode; `episodes` are those so far, shape (steps, ...)."""

    def __init__(self, episodes: Iterable[NDArray[Any]]) -> None:
        self._parts = [[actions] for actions in episodes]
        self._bytes = [actions.nbytes for (actions,) in self._parts]

    def add_segment(self, actions: NDArray[Any], ended: Iterable[tuple[int, int]]) -> None:
        """Store a segment, shape (n_envs, steps, ...), in which episodes ended: (environment, row) each, by row."""
        last = dict(ended)
        for env, rows in enumerate(actions):
            new = rows[last.get(env, -1) + 1 :].copy()
            if env in last:
                self._parts[env], self._bytes[env] = [], 0
            self._bytes[env] += new.nbytes
            if self._bytes[env] <= MAX_BYTES // len(actions):
                self._parts[env].append(new)

    def of(self, env: int) -> NDArray[Any] | None:
        """Return the actions of an environment's episode so far, shape (steps, ...); None if they are too many."""
        parts = self._parts[env]
        return np.concatenate(parts) if sum(part.nbytes for part in parts) == self._bytes[env] else None

    def all(self) -> list[NDArray[Any] | None]:
        """Return `of` every environment."""
        return [self.of(env) for env in range(len(self._parts))]
