"""Where a child process is, in memory that its parent sees too: so a hang or a crash can be placed."""

from __future__ import annotations

import dataclasses
import mmap
import os

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env import studies

CALLS = ("", "load", "build", "reset", "step", "close", "sample", "check", "render", "compute_reward")
PHASES = (
    "build",
    *studies.names(),
    # Parts of studies.
    "reused",
    "dirty",
    "seeds",
    "alone",
    "fresh instance",
    "interleaved",
    "after close",
    "close",
)

_SIZE = 64  # [bytes]


@dataclasses.dataclass(frozen=True)
class Where:
    """A moment of a child process."""

    counter: int
    call: str
    """What of the environment is being called; empty between calls."""
    phase: str
    episode: int
    seed: int
    step: int
    is_first: bool
    """Whether it is the first call of its kind in the process: what is compiled or loaded late is in it."""


class Progress:
    """Written by the child at every call, read by the parent. Without a descriptor it is seen by nobody else."""

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None:
            self._numbers: NDArray[np.int64] = np.zeros(_SIZE // 8, np.int64)
        else:
            os.ftruncate(descriptor, _SIZE)
            self._numbers = np.frombuffer(mmap.mmap(descriptor, _SIZE), np.int64)
        self._called: set[str] = set()

    def phase(self, name: str) -> None:
        """Note what is being tried."""
        self._numbers[2] = PHASES.index(name)

    def episode(self, episode: int, seed: int) -> None:
        """Note which episode begins."""
        self._numbers[3:6] = episode, seed, 0

    def enter(self, call: str, step: int = 0) -> None:
        """Note that a call into the environment begins."""
        self._numbers[5:7] = step, call not in self._called
        self._called.add(call)
        self._numbers[1] = CALLS.index(call)
        self._numbers[0] += 1

    def leave(self) -> None:
        """Note that the call came back."""
        self._numbers[1] = 0
        self._numbers[0] += 1

    def read(self) -> Where:
        """Return where the child is."""
        counter, call, phase, episode, seed, step, is_first = self._numbers[:7].tolist()
        return Where(counter, CALLS[call], PHASES[phase], episode, seed, step, bool(is_first))
