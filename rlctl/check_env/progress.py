"""Where a child process is, in memory that its parent reads too: so a hang or a crash can be placed."""

from __future__ import annotations

import dataclasses
import mmap
import os

import numpy as np
from numpy.typing import NDArray

CALLS = ("", "load", "build", "reset", "step", "close", "sample", "render", "compute_reward")
_NUMBERS = 6
_PHASE_BYTES = 64
_SIZE = 8 * _NUMBERS + _PHASE_BYTES


@dataclasses.dataclass(frozen=True)
class Position:
    """A moment of a child process."""

    counter: int
    call: str
    """What of the environment is being called; empty between calls."""
    phase: str
    """The experiment, or the part of one."""
    episode: int
    seed: int
    step: int
    is_first: bool
    """Whether it is the first call of its kind in the process, which may compile or load something."""


class Progress:
    """Written by the child at every call, read by the parent. Without a descriptor nobody else reads it."""

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None:
            memory: mmap.mmap | bytearray = bytearray(_SIZE)
        else:
            os.ftruncate(descriptor, _SIZE)
            memory = mmap.mmap(descriptor, _SIZE)
        self._numbers: NDArray[np.int64] = np.frombuffer(memory, np.int64, _NUMBERS)
        self._phase: NDArray[np.uint8] = np.frombuffer(memory, np.uint8, _PHASE_BYTES, 8 * _NUMBERS)
        self._called: set[str] = set()

    def phase(self, name: str) -> None:
        """Note which experiment, or part of one, begins."""
        text = np.frombuffer(name.encode()[:_PHASE_BYTES].ljust(_PHASE_BYTES, b"\0"), np.uint8)
        self._phase[:] = text

    def episode(self, episode: int, seed: int) -> None:
        """Note which episode begins."""
        self._numbers[2:5] = episode, seed, 0

    def enter(self, call: str, step: int = 0) -> None:
        """Note that a call into the environment begins."""
        self._numbers[4:6] = step, call not in self._called
        self._called.add(call)
        self._numbers[1] = CALLS.index(call)
        self._numbers[0] += 1

    def leave(self) -> None:
        """Note that the call came back."""
        self._numbers[1] = 0
        self._numbers[0] += 1

    def read(self) -> Position:
        """Return where the child is."""
        counter, call, episode, seed, step, is_first = self._numbers.tolist()
        phase = self._phase.tobytes().rstrip(b"\0").decode(errors="replace") or "build"
        return Position(counter, CALLS[call], phase, episode, seed, step, bool(is_first))
