"""Replay buffers that store each value of a history once; the histories are put together when they are read.

A transition of a replay buffer of Stable-Baselines3 has two whole observations, so a history of 5 values takes five
times the memory. Here the buffer's `observations` and `next_observations` are replaced by objects that look like the
arrays that they were, to Stable-Baselines3 too, and hold the newest values only.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

Numbers = NDArray[np.int64]


class Stacking:
    """Which value each element of an observation is: `source` in the newest values, `back` steps ago; both flat."""

    def __init__(self, source: Numbers, back: Numbers) -> None:
        self.frames = int(back.max()) + 1
        self.size = int(source.max()) + 1
        """Elements of the newest values."""
        self.columns = [np.flatnonzero(back == steps) for steps in range(self.frames)]
        self.sources = [source[columns] for columns in self.columns]
        self.newest = self.columns[0][np.argsort(self.sources[0])]
        """The elements of an observation that are newest values, in the order of these."""


def store_once(buffer: Any, layout: Stacking | None, start: str) -> None:
    """Let a buffer store each value once, if its observations are histories; `start` is what fills them at first."""
    if layout is not None and type(buffer) in (ReplayBuffer, NStepReplayBuffer) and not buffer.optimize_memory_usage:
        stacks = Stacks(buffer, layout, start == "first")
        buffer.observations, buffer.next_observations = StackedRows(stacks, 0), StackedRows(stacks, 1)


class Stacks:
    """The newest values of the transitions of a buffer, numbered in the order of the steps of all environments.

    It holds some transitions more than the buffer, of which the oldest histories have values.
    """

    def __init__(self, buffer: ReplayBuffer, layout: Stacking, repeats_first: bool) -> None:
        self.buffer, self.layout, self._repeats_first = buffer, layout, repeats_first
        self.shape: tuple[int, ...] = buffer.obs_shape
        self.dtype = buffer.observations.dtype
        self.added = 0
        self.capacity = buffer.buffer_size + layout.frames - 1
        self._newest = np.zeros((self.capacity, buffer.n_envs, layout.size), self.dtype)
        self._next = np.zeros((buffer.buffer_size, buffer.n_envs, layout.size), self.dtype)
        self._ages = np.zeros((self.capacity, buffer.n_envs), np.int16)
        """Number of earlier values of the episode, at most those of the histories."""

    @property
    def nbytes(self) -> int:
        """Memory of all values [bytes]."""
        return self._newest.nbytes + self._next.nbytes + self._ages.nbytes

    def _number(self, rows: Numbers) -> Numbers:
        """Return the numbers of the transitions in rows of the buffer."""
        last = self.added - 1
        return last - (last - rows) % self.buffer.buffer_size

    def read(self, rows: Numbers, envs: Numbers, later: int) -> NDArray[Any]:
        """Return the observations before (`later` 0) or after (1) the steps of transitions, shape (..., *shape)."""
        layout, number = self.layout, self._number(rows)
        rows, envs, number = np.broadcast_arrays(rows, envs, number)
        ages = self._ages[number % self.capacity, envs]
        values = np.empty((*number.shape, math.prod(self.shape)), self.dtype)
        for steps, (columns, sources) in enumerate(zip(layout.columns, layout.sources, strict=True)):
            if later and steps == 0:
                seen = self._next[rows, envs]
            else:
                back = steps - later
                seen = self._newest[(number - np.minimum(back, ages)) % self.capacity, envs]
                if not self._repeats_first:
                    seen[back > ages] = 0
            values[..., columns] = seen[..., sources]
        return values.reshape(*number.shape, *self.shape)

    def add(self, values: NDArray[Any], later: int) -> None:
        """Add the observations of a step of all environments, shape (environments, *shape), first those before it."""
        newest = values.reshape(len(values), -1)[:, self.layout.newest]
        if later:
            self._next[(self.added - 1) % self.buffer.buffer_size] = newest
            return
        slot, before = self.added % self.capacity, (self.added - 1) % self.capacity
        self._newest[slot] = newest
        ended = self._has_ended((self.added - 1) % self.buffer.buffer_size) if self.added else True
        self._ages[slot] = np.where(ended, 0, np.minimum(self._ages[before] + 1, self.layout.frames - 1))
        self.added += 1

    def _has_ended(self, rows: Any) -> NDArray[np.bool_]:
        # Episodes that a new stage has cut short are not done.
        ended: NDArray[np.bool_] = (self.buffer.dones[rows] != 0) | (self.buffer.timeouts[rows] != 0)
        return ended

    def load(self, rows: Numbers, values: NDArray[Any], later: int) -> None:
        """Write observations of a saved buffer, shape (n, environments, *shape); then call `finish_loading`."""
        flat = values.reshape(*values.shape[:2], -1)
        if later:
            self._next[rows] = flat[..., self.layout.newest]
            return
        numbers = self._number(rows)
        self._newest[numbers % self.capacity] = flat[..., self.layout.newest]
        oldest = max(0, self.added - self.buffer.buffer_size)
        for index in np.flatnonzero(numbers == oldest):
            for steps in range(1, self.layout.frames):
                slot = (oldest - steps) % self.capacity
                self._newest[slot][:, self.layout.sources[steps]] = flat[index][:, self.layout.columns[steps]]

    def finish_loading(self) -> None:
        """Find where episodes begin; what was before the oldest transition is in its histories."""
        oldest, longest = max(0, self.added - self.buffer.buffer_size), self.layout.frames - 1
        numbers = np.arange(oldest, self.added)
        begins = np.zeros((len(numbers), self.buffer.n_envs), bool)
        begins[1:] = self._has_ended(numbers[:-1] % self.buffer.buffer_size)
        places = np.arange(len(numbers))[:, None]
        first = np.maximum.accumulate(np.where(begins, places, -longest), axis=0)
        self._ages[numbers % self.capacity] = np.minimum(places - first, longest)


class StackedRows:
    """Looks like the array of the observations before (`later` 0) or after (1) the steps of a buffer's transitions."""

    def __init__(self, stacks: Stacks, later: int) -> None:
        self.stacks, self._later = stacks, later

    @property
    def nbytes(self) -> int:
        """Memory of both kinds of observations together, half of it [bytes]."""
        return self.stacks.nbytes // 2

    def __getitem__(self, key: Any) -> NDArray[Any]:
        stacks = self.stacks
        if isinstance(key, tuple):
            return stacks.read(np.asarray(key[0]), np.asarray(key[1]), self._later)
        rows = np.arange(stacks.buffer.buffer_size)[key]
        return stacks.read(rows[..., None], np.arange(stacks.buffer.n_envs), self._later)

    def __setitem__(self, key: Any, values: NDArray[Any]) -> None:
        if isinstance(key, int):  # the next transition
            self.stacks.add(values, self._later)
        else:
            self.stacks.load(np.asarray(key), values, self._later)
