"""Reads the lines that child processes and environments print, limits their rate, and writes them to stderr."""

import contextlib
import os
import threading
import time
from collections.abc import Callable

MAX_LINE_BYTES = 1000  # bytes
MAX_LINES_PER_S = 100


class LineReader:
    """Calls a function with each line that is written to `descriptor`, in a thread.

    Close `descriptor` (`close_descriptor`) once the children that write to it have been started. A line longer than
    `max_bytes` is split.
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
        """Close this process's end of the pipe: the thread ends when the last child closes its own."""
        os.close(self.descriptor)

    def wait(self, timeout_s: float = 1.0) -> None:
        """Wait until all written lines have been read, at most `timeout_s`."""
        self._thread.join(timeout=timeout_s)


class LineFilter:
    """Passes lines that environments print to `receive`, at most 100 per second.

    A printing process blocks while nobody reads, so lines above this rate are counted and dropped. All lines are
    dropped after `receive` raises `OSError`, as a closed stderr does.
    """

    def __init__(self, receive: Callable[[str], None]) -> None:
        self._receive = receive
        self._closed = False
        self._last = self._bullet_head = ""
        self._second = self._lines = self._left_out = 0  # lines in this second
        self._bullet_warnings: set[str] = set()

    def line(self, text: str) -> None:
        """Pass on a line, unless it repeats the last one or lines come too fast."""
        if text == self._last or text.startswith("pybullet build time"):
            return
        # PyBullet's warnings have two lines; the second contains the reason.
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
            # Control characters could change a terminal's state.
            self._report("".join(char if char.isprintable() or char == "\t" else "\ufffd" for char in text))

    def end(self) -> None:
        """Report how many lines were left out, if any."""
        if self._left_out:
            self._report(f"({self._left_out:,} more lines printed by environments are left out)")
        self._left_out = 0

    def _report(self, text: str) -> None:
        try:
            if not self._closed:
                self._receive(text)
        except OSError:
            self._closed = True


def write_stderr(text: str) -> None:
    """Write a line to stderr, even if an environment has closed or replaced `sys.stderr`."""
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode(errors="replace"))
