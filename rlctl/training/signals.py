"""Signals that stop a training."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

from rlctl import output
from rlctl.errors import Interrupted
from rlctl.processes.child_process import STOP_SIGNALS

if TYPE_CHECKING:
    from rlctl.training.loop import TrainingLoop

_SAME_S = 1.0  # equal signals within this time count once: `timeout` sends SIGTERM to the process and to its group

_WARNINGS = (signal.SIGUSR1, signal.SIGUSR2)

Handler = Callable[[int, FrameType | None], None]


class HandledSignals:
    """Passes stop signals to `handle` while it is entered.

    SIGHUP comes from a closed terminal. SIGUSR1 and SIGUSR2, which a cluster sends as a warning, count as SIGTERM.
    """

    def __init__(self, handle: Handler) -> None:
        self._handler = lambda number, frame: handle(signal.SIGTERM if number in _WARNINGS else number, frame)
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Python has signal handlers in the main thread only; a caller in another keeps its own.
        if threading.current_thread() is threading.main_thread():
            # Shells let background commands ignore SIGINT: handle it anyway. `nohup` ignores SIGHUP: keep that.
            self._before = {
                number: signal.getsignal(number)
                for number in STOP_SIGNALS
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
            }
        self.handle_again()
        return self

    def handle_again(self) -> None:
        """Set the handlers again: importing a task may have replaced them."""
        for number in self._before:
            signal.signal(number, self._handler)

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


class StopSignals(HandledSignals):
    """Stops a training by signals.

    Before the training a signal ends the process immediately. During it the first signal stops at the next boundary; a
    second stops immediately if it is a different signal or comes over a second later. After it signals do nothing.
    """

    def __init__(self) -> None:
        super().__init__(self._handle)
        self._loop: TrainingLoop | None = None
        self._done = False
        self._received_s = 0.0

    def begin(self, loop: TrainingLoop) -> None:
        """Stop `loop` at a boundary from now on."""
        self._loop = loop
        self.handle_again()

    def end(self) -> None:
        """Ignore later signals: the training is done and saved."""
        self._done = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # No output here: it could interrupt other output.
        if number == signal.SIGHUP:
            output.leave_closed_terminal()
        if self._done and not (self._loop and self._loop.callbacks.running):
            return
        if self._loop is None or not self._loop.has_begun:
            raise Interrupted("interrupted before the training began", number)
        if self._loop.stop_signal is not None:
            if number == self._loop.stop_signal and time.monotonic() - self._received_s < _SAME_S:
                return
            raise Interrupted("interrupted again: stopped at once, the last checkpoint is intact", number)
        self._loop.stop_signal = number
        self._received_s = time.monotonic()
        if self._loop.callbacks.running:  # it may never return
            raise Interrupted(f"interrupted in {self._loop.callbacks.running}; the last checkpoint is intact", number)
