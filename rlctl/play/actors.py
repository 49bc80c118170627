"""`RowsOfPlayers`: what chooses the actions of rows, made of one player per row or of one policy for all."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import take_row
from rlctl.errors import in_world
from rlctl.play.playing import Rows
from rlctl.policy.players.player import Exploration, Player
from rlctl.policy.rows import RowsPolicy


class RowsOfPlayers:
    """One forward pass for all rows, or a player per row where there is none."""

    def __init__(
        self,
        rows: RowsPolicy | None,
        make: Callable[[], Player] | None,
        count: int,
        states: NDArray[np.float32] | None = None,
    ) -> None:
        self._rows = rows
        self._single: Sequence[Player] = [make() for _ in range(count)] if make is not None else []
        self._states = states  # recurrent states that the main process sees, shape (count, 2, layers, hidden)
        self._exploration = Exploration()

    def explore(self, exploration: Exploration) -> None:
        """Use this exploration from now on."""
        self._exploration = exploration
        for player in self._single:
            player.explore(exploration)

    def prepare(self, rows: Rows) -> None:
        """Continue the episodes of a segment; the policy's weights may have changed."""
        if self._rows is not None:
            self._rows.begin_segment()
        for place, seed, step in rows.listed if self._single else ():
            player = self._single[place]
            if player.state is not None and self._states is not None:
                player.state[:] = self._states[place]
            player.begin_segment(seed, step)

    def end_segment(self, index: NDArray[np.int64]) -> None:
        """Let the main process see the recurrent states."""
        if self._states is not None:
            for place in index.tolist():
                self._states[place] = self._single[place].state

    def begin(self, index: NDArray[np.int64]) -> None:
        """Forget the recurrent states of rows whose episode begins."""
        for place in index.tolist() if self._single else ():
            state = self._single[place].state
            if state is not None:
                state[:] = 0.0
            if self._states is not None:
                self._states[place] = 0.0

    def report(self, place: int) -> dict[str, Any]:
        """Return the player's report of the episode that ended in a row."""
        return self._single[place].report() if self._single else {}

    def act(self, observations: Any, rows: Rows) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the actions to store, shape (k, elements), and those for the environments, shape (k, ...)."""
        if self._rows is not None:
            return self._rows.act(observations, rows.seed, rows.step, rows.index, self._exploration)
        stored, actions = [], []
        place = 0
        try:
            for k, (place, seed, step) in enumerate(rows.listed):
                one, action = self._single[place].act(take_row(observations, k), seed, step)
                stored.append(np.ravel(one))
                actions.append(action)
        except Exception as error:
            with in_world(place):
                raise error
        return np.array(stored), np.array(actions)

    def close(self) -> None:
        """Release resources."""
        for player in self._single:
            player.close()
