"""What environments print: told line by line, as far as anybody can read it."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable

LONGEST_LINE = 1000  # bytes
MOST_LINES_PER_S = 100


def forward(read_end: int, receive: Callable[[str], None]) -> None:
    """Hand what comes out of a pipe to `receive`, until all its writers are gone; closes it.

    Whoever prints waits while nobody reads: so what comes too fast is counted, not told, and if `receive` raises
    `OSError`, as a closed stderr does, the rest is read for nobody.
    """
    teller = _Teller(receive)
    with os.fdopen(read_end, "rb") as pipe:
        while line := pipe.readline(LONGEST_LINE):
            teller.line(line.decode(errors="replace"))
    teller.end()


class _Teller:
    def __init__(self, receive: Callable[[str], None]) -> None:
        self._receive = receive
        self._closed = False
        self._last = ""
        self._second = 0
        self._lines = 0  # in this second
        self._left_out = 0

    def line(self, text: str) -> None:
        # Many environments say the same; once is enough.
        if text == self._last or text.startswith("pybullet build time"):
            return
        self._last = text
        second = int(time.monotonic())
        if second != self._second:
            self.end()
            self._second, self._lines = second, 0
        self._lines += 1
        if self._lines > MOST_LINES_PER_S:
            self._left_out += 1
        else:
            self._tell(printable(text))

    def end(self) -> None:
        if self._left_out:
            self._tell(f"({self._left_out:,} more lines of what environments print are left out)")
        self._left_out = 0

    def _tell(self, text: str) -> None:
        try:
            if not self._closed:
                self._receive(text)
        except OSError:
            self._closed = True


def printable(text: str) -> str:
    """Return a line without what would move a terminal's cursor, or worse."""
    return "".join(each if each.isprintable() or each == "\t" else "\ufffd" for each in text.rstrip("\r\n"))


def say(text: str) -> None:
    """In a worker: tell something beside what its environments print."""
    # Not by print: an environment may have closed or replaced what that writes to.
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode(errors="replace"))
