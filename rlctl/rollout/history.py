"""The actions of the episodes that environments are in: what it takes to replay them up to now."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_BYTES = 2**28
"""Memory for actions, 256 MB. An episode that goes back further than that cannot be replayed."""


class ActionHistory:
    """Stores the actions of all environments since the oldest of their running episodes began."""

    def __init__(self, n_envs: int) -> None:
        self._rows: deque[NDArray[Any]] = deque()
        self._first = 0  # number of the first stored row
        self._began = np.zeros(n_envs, np.int64)  # number of each episode's first row

    @classmethod
    def of_episodes(cls, episodes: Sequence[NDArray[Any]], row: NDArray[Any]) -> ActionHistory:
        """Return the history after the actions of `episodes`, shape (steps, ...) each.

        `row` is an array with the actions of all environments in a step.
        """
        history = cls(len(episodes))
        longest = max(len(actions) for actions in episodes)
        rows = np.zeros((longest, *row.shape), row.dtype)
        for env, actions in enumerate(episodes):
            rows[longest - len(actions) :, env] = actions
            history._began[env] = longest - len(actions)
        history._rows.extend(rows)
        return history

    def add_segment(self, actions: NDArray[Any], ended: Iterable[tuple[int, int]]) -> None:
        """Store a segment, shape (n_envs, steps, ...), in which episodes ended: (environment, row) each."""
        first = self._first + len(self._rows)
        self._rows.extend(actions.swapaxes(0, 1).copy())
        for env, row in ended:
            self._began[env] = first + row + 1
        if excess := max(0, len(self._rows) * actions[:, 0].nbytes - MAX_BYTES):
            self._drop(self._first + -(-excess // actions[:, 0].nbytes))
        self._drop(int(self._began.min()))

    def _drop(self, first: int) -> None:
        while self._first < first:
            self._rows.popleft()
            self._first += 1

    def of(self, env: int) -> NDArray[Any] | None:
        """Return the actions of an environment's episode so far, shape (steps, ...); None if it goes too far back."""
        start = int(self._began[env]) - self._first
        if start < 0:
            return None
        return np.array([self._rows[index][env] for index in range(start, len(self._rows))])

    def all(self) -> list[NDArray[Any] | None]:
        """Return `of` every environment, in one go."""
        if not self._rows:
            return [np.zeros(0)] * len(self._began)
        rows = np.stack(self._rows)
        starts = (self._began - self._first).tolist()
        return [rows[start:, env] if start >= 0 else None for env, start in enumerate(starts)]
