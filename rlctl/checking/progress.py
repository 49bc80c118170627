"""The position of a child process, in memory shared with its parent to locate hangs and crashes; and its clock.

Time limits use this clock, so that a busy machine judges as much as an idle one: it stands still while a process waits
for a processor. Linux counts that in `schedstat`; elsewhere it is the ordinary time.
"""

import ctypes
import dataclasses
import mmap
import time
from pathlib import Path
from typing import Any

from rlctl.processes.child_process import grow_anonymous_file


@dataclasses.dataclass(frozen=True)
class Position:
    """A moment of a child process."""

    counter: int
    call: str  # What of the environment is being called; empty between calls
    phase: str  # The experiment, or the part of one
    episode: int
    seed: int
    step: int
    is_first: bool  # the process's first call of its kind, which may compile or load


_KINDS: dict[Any, Any] = {int: ctypes.c_int64, str: ctypes.c_char * 64, bool: ctypes.c_bool}


class _Memory(ctypes.Structure):
    _fields_ = tuple((field.name, _KINDS[field.type]) for field in dataclasses.fields(Position))


class CallProgress:
    """Written by the child at every call, read by the parent. Without a descriptor nobody else reads it."""

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None:
            self._now = _Memory()
        else:
            grow_anonymous_file(descriptor, ctypes.sizeof(_Memory))
            self._now = _Memory.from_buffer(mmap.mmap(descriptor, ctypes.sizeof(_Memory)))
        self._called: set[str] = set()
        self._entered, self._began = "", 0.0
        self._step_began: float | None = None  # of the step before, in the same episode
        self._times: dict[str, list[float]] = {}  # number and time [s] of the calls of a kind, without the first

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
        self._entered, self._began = "" if now.is_first else call, read_clock()
        if call == "step":
            if self._step_began is not None:
                self._count("step", self._began - self._step_began)
            self._step_began = self._began
        elif call != "sample":
            self._step_began = None

    def leave(self) -> None:
        """Note that the call came back."""
        if self._entered not in ("", "step"):
            self._count(self._entered, read_clock() - self._began)
        self._entered = ""
        self._now.call = b""
        self._now.counter += 1

    def _count(self, call: str, seconds: float) -> None:
        times = self._times.setdefault(call, [0, 0.0])
        times[0] += 1
        times[1] += seconds

    def mean_s(self, call: str, fewest: int = 5) -> float | None:
        """Return the mean time of the calls of a kind so far [s]; None before there were a few.

        That of `step` is from one step to the next: with what the check itself does between them.
        """
        number, seconds = self._times.get(call, (0, 0.0))
        return seconds / number if number >= fewest else None

    def read(self) -> Position:
        """Return where the child is."""
        now = self._now
        call, phase = now.call.decode(), now.phase.decode() or "build"
        return Position(now.counter, call, phase, now.episode, now.seed, now.step, now.is_first)


INTERVAL_S = 0.01  # reading the count takes longer than many an episode's step
_last_read = {"at": float("-inf"), "waited_s": 0.0}


def read_clock() -> float:
    """Return the time of this process [s]; only differences have a meaning."""
    now = time.monotonic()
    if now - _last_read["at"] > INTERVAL_S:
        _last_read.update(at=now, waited_s=read_waited_s())
    return now - _last_read["waited_s"]


def read_clock_of(pid: int) -> float:
    """Return the time of another process [s]; only differences have a meaning."""
    return time.monotonic() - read_waited_s(str(pid))


def read_waited_s(process: str = "self") -> float:
    """Return for how long a process, given by its id, has waited for a processor [s]; 0 where that is not counted."""
    try:
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError):
        return 0.0
