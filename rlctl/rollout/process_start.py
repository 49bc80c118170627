"""How worker processes are started: as fresh interpreters, unless another way is set."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Protocol


class Process(Protocol):
    """What is needed of a started process; `subprocess.Popen` has it."""

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None:
        """Return the exit code, None while the process runs."""
        ...

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code, the negative number of a signal that killed it; raise `subprocess.TimeoutExpired`."""
        ...


StartProcess = Callable[..., Process]
"""Takes what `subprocess.Popen` takes: a command, and keyword arguments."""

_default: StartProcess = subprocess.Popen


def default_start() -> StartProcess:
    """Return how worker processes are started if `Workers` is given no `start`."""
    return _default


def set_default_start(start: StartProcess) -> None:
    """Set how this process starts all its workers: tests, which start many, fork them from a process made for it."""
    global _default
    _default = start
