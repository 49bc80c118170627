"""Lines that child processes and environments print: read, thinned out, and written where they can be seen."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable

MAX_LINE_BYTES = 1000  # bytes
MAX_LINES_PER_S = 100


class LineReader:
    """Hands each line that is written to `descriptor` to a function, in a thread of its own.

    Close `descriptor` (`close_descriptor`) once the children that write to it have been started. A line of more than
    `max_bytes` comes in parts.
    """

    def __init__(self, receive: Callable[[str], None], max_bytes: int = -1) -> None:
        read_end, self.descriptor = os.pipe()
        self._receive = receive
        self._max_bytes = max_bytes
        self._thread = threading.Thread(target=self._read, args=(read_end,), daemon=True)
        self._thread.start()

    def _read(self, read_end: int) -> None:
        with os.fdopen(read_end, "rb") as pipe:
            while line := pipe.readline(self._max_bytes):
                self._receive(line.decode(errors="replace").rstrip("\r\n"))

    def close_descriptor(self) -> None:
        """Close this process's end of the pipe: the thread ends with the last child that holds it."""
        os.close(self.descriptor)

    def wait(self, timeout_s: float = 1.0) -> None:
        """Wait until everything that was written has been read, if that is soon."""
        self._thread.join(timeout=timeout_s)


class LineFilter:
    """Hands lines that environments print to `receive`, at a rate that can be read.

    A process that prints blocks while nobody reads, so lines that come too fast are counted and dropped, and if
    `receive` raises `OSError`, as a closed stderr does, all that follow.
    """

    def __init__(self, receive: Callable[[str], None]) -> None:
        self._receive = receive
        self._closed = False
        self._last = ""
        self._second = 0
        self._lines = 0  # in this second
        self._left_out = 0
        self._bullet_head = ""
        self._bullet_warnings: set[str] = set()

    def line(self, text: str) -> None:
        """Take a line."""
        # Many environments print the same line; once is enough.
        if text == self._last or text.startswith("pybullet build time"):
            return
        # PyBullet's warnings have two lines, the second of which says what is wrong.
        if text.startswith(("b3Warning[", "b3Error[")):
            self._bullet_head = text
            return
        if self._bullet_head:
            text, self._bullet_head = f"{self._bullet_head} {text}", ""
            if text in self._bullet_warnings:
                return
            self._bullet_warnings.add(text)
        self._last = text
        second = int(time.monotonic())
        if second != self._second:
            self.end()
            self._second, self._lines = second, 0
        self._lines += 1
        if self._lines > MAX_LINES_PER_S:
            self._left_out += 1
        else:
            self._report(replace_control_characters(text))

    def end(self) -> None:
        """Report how many lines were left out, if any."""
        if self._left_out:
            self._report(f"({self._left_out:,} more lines of what environments print are left out)")
        self._left_out = 0

    def _report(self, text: str) -> None:
        try:
            if not self._closed:
                self._receive(text)
        except OSError:
            self._closed = True


def replace_control_characters(text: str) -> str:
    """Return a line without what would move a terminal's cursor, or worse."""
    return "".join(character if character.isprintable() or character == "\t" else "\ufffd" for character in text)


def write_stderr(text: str) -> None:
    """Write a line beside what environments print."""
    # Not by print: an environment may have closed or replaced what that writes to.
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode(errors="replace"))
