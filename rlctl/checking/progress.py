"""Where a child process is, in memory that its parent reads too: so a hang or a crash can be placed."""

from __future__ import annotations

import ctypes
import dataclasses
import mmap
import os


class _Memory(ctypes.Structure):
    _fields_ = (
        ("counter", ctypes.c_int64),
        ("call", ctypes.c_char * 16),
        ("phase", ctypes.c_char * 64),
        ("episode", ctypes.c_int64),
        ("seed", ctypes.c_int64),
        ("step", ctypes.c_int64),
        ("is_first", ctypes.c_bool),
    )


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


class CallProgress:
    """Written by the child at every call, read by the parent. Without a descriptor nobody else reads it."""

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None:
            self._now = _Memory()
        else:
            os.ftruncate(descriptor, ctypes.sizeof(_Memory))
            self._now = _Memory.from_buffer(mmap.mmap(descriptor, ctypes.sizeof(_Memory)))
        self._called: set[str] = set()

    def phase(self, name: str) -> None:
        """Note which experiment, or part of one, begins."""
        self._now.phase = name.encode()

    def episode(self, episode: int, seed: int) -> None:
        """Note which episode begins."""
        self._now.episode, self._now.seed, self._now.step = episode, seed, 0

    def enter(self, call: str, step: int = 0) -> None:
        """Note that a call into the environment begins."""
        now = self._now
        now.step, now.is_first, now.call = step, call not in self._called, call.encode()
        now.counter += 1
        self._called.add(call)

    def leave(self) -> None:
        """Note that the call came back."""
        self._now.call = b""
        self._now.counter += 1

    def read(self) -> Position:
        """Return where the child is."""
        now = self._now
        call, phase = now.call.decode(), now.phase.decode() or "build"
        return Position(now.counter, call, phase, now.episode, now.seed, now.step, now.is_first)
