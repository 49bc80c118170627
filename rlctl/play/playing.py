"""`Playing`: the one loop that plays episodes, of worlds and of what chooses their actions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import map_parts, split
from rlctl.environments.gym_worlds import GymWorlds
from rlctl.policy.actor import Actor, Array, Rows, act_one_by_one
from rlctl.task.world_index import WorldIndex
from rlctl.task.worlds import TaskWorlds, WorldsStep

Flags = NDArray[np.bool_]


Worlds = TaskWorlds | GymWorlds
"""`count` worlds, each with its own episode, of a task or a Gymnasium environment. All arrays have a row per world."""


@dataclasses.dataclass(slots=True)
class Played:
    """A step of some worlds.

    It is valid until the next one. `Playing.begin` writes the first observation of an episode over the last one of the
    episode before, in `result.observation`.
    """

    index: WorldIndex  # of the worlds, shape (k,)
    action: Any
    result: WorldsStep
    ended: WorldIndex  # the worlds whose episode has ended


class NoMoreActions(Exception):
    """An actor has no action for the next step: the loop ends."""


class Playing:
    """The episodes that run in `worlds`; whoever iterates over `play` observes them."""

    def __init__(self, worlds: Worlds) -> None:
        self.worlds = worlds
        self.seeds: NDArray[np.int64] = np.full(worlds.count, -1, np.int64)  # of the episode of each world
        self._has_begun: Flags = np.zeros(worlds.count, bool)  # in which worlds an episode has followed the ended one
        self._none: WorldIndex = np.zeros(0, np.int64)
        self._index = self._none  # the worlds that play
        self._observations: Any = None  # of these, before their next action

    def begin(self, index: WorldIndex, seeds: Sequence[int], levels: NDArray[np.float64] | None = None) -> Any:
        """Begin the episodes of `seeds` in some worlds; return their first observations, shape (k, ...).

        In the loop of `play` they follow on episodes that ended.
        """
        self.seeds[index] = seeds
        first = self.worlds.reset(index, seeds, levels)
        self._has_begun[index] = True
        if len(self._index):
            at = np.searchsorted(self._index, index)
            for key, part in split(self._observations).items():
                part[at] = split(first)[key]
        return first

    def select(self, index: WorldIndex) -> Rows:
        """Return some worlds as rows."""
        if len(index) == self.worlds.count:
            return Rows(index, self.seeds, self.worlds.step_of)
        return Rows(index, self.seeds[index], self.worlds.step_of[index])

    def play(self, actor: Actor, index: WorldIndex, observations: Any) -> Iterator[Played]:
        """Continue the episodes of worlds, in ascending order, whose `observations` are given; yield each step.

        An episode that ends leaves, unless another has begun there. `NoMoreActions` from the actor ends the loop; other
        exceptions are those of worlds and actor.
        """
        self._index, self._observations = index, observations
        try:
            while len(self._index):
                rows = self.select(self._index)
                try:
                    _, action = actor.act(self._observations, rows)
                except NoMoreActions:
                    return
                result = self.worlds.step(action, rows.index)
                self._observations = result.observation
                ended = self._none
                if True in result.terminated.tolist() or True in result.truncated.tolist():  # faster than NumPy's any
                    ended = rows.index[result.terminated | result.truncated]
                    self._has_begun[ended] = False
                yield Played(rows.index, action, result, ended)
                if len(ended):
                    self.stop(ended[~self._has_begun[ended]])
        finally:
            self._index = self._none

    def stop(self, worlds: WorldIndex) -> None:
        """Let some worlds play no further."""
        staying = np.isin(self._index, worlds, invert=True)
        if not staying.all():
            self._index = self._index[staying]
            self._observations = map_parts(lambda part: part[staying], self._observations)


class RecordedActions(Actor):
    """Acts as recorded; `actions` has those of each row."""

    def __init__(self, actions: dict[int, NDArray[Any]]) -> None:
        self._actions = actions

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the recorded action of each row; raises `IndexError` after the last one."""
        return act_one_by_one(observations, rows, lambda _, row, seed, step: self._actions[row][step])
