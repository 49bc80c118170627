"""Signals that ask a training to stop, whatever it is doing."""

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

_SAME_S = 1.0  # equal signals within it are one: `timeout` sends SIGTERM to the process and to its group

_WARNINGS = (signal.SIGUSR1, signal.SIGUSR2)

Handler = Callable[[int, FrameType | None], None]


class HandledSignals:
    """Lets `handle` take the signals that ask to stop, as long as it is entered.

    SIGHUP comes from a closed terminal. SIGUSR1 and SIGUSR2, which a cluster sends as a warning, count as SIGTERM.
    """

    def __init__(self, handle: Handler) -> None:
        self._handler = lambda number, frame: handle(signal.SIGTERM if number in _WARNINGS else number, frame)
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Python has signal handlers in the main thread only; a caller in another keeps its own.
        if threading.current_thread() is threading.main_thread():
            # Set even where a shell has made SIGINT ignored, as for a command in the background; what `nohup` has made
            # ignored stays so.
            self._before = {
                number: signal.getsignal(number)
                for number in STOP_SIGNALS
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
            }
        self.handle_again()
        return self

    def handle_again(self) -> None:
        """Set the handlers anew: importing a task may have put others there."""
        for number in self._before:
            signal.signal(number, self._handler)

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


class StopSignals(HandledSignals):
    """Stops a training by signals.

    Before the training they end the process at once; while it goes on the first ends it at the next boundary and the
    second at once, if it is another signal or comes more than a second later; when it is done they change nothing.
    """

    def __init__(self) -> None:
        super().__init__(self._handle)
        self._loop: TrainingLoop | None = None
        self._done = False
        self._received_s = 0.0

    def begin(self, loop: TrainingLoop) -> None:
        """From now on let `loop` end the training at a boundary."""
        self._loop = loop
        self.handle_again()

    def end(self) -> None:
        """The training is done and saved: later signals change nothing."""
        self._done = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # No output here: it might come in the middle of another.
        if number == signal.SIGHUP:
            output.leave_closed_terminal()
        if self._done:
            return
        if self._loop is None:
            raise Interrupted("interrupted before the training began", number)
        if self._loop.stop_signal is not None:
            if number == self._loop.stop_signal and time.monotonic() - self._received_s < _SAME_S:
                return
            raise Interrupted("interrupted again: stopped at once, the last checkpoint is intact", number)
        self._loop.stop_signal = number
        self._received_s = time.monotonic()
