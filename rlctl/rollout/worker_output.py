"""What environments print, forwarded line by line at a readable rate."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable

MAX_LINE_BYTES = 1000  # bytes
MAX_LINES_PER_S = 100


def forward(read_end: int, receive: Callable[[str], None]) -> None:
    """Hand what comes out of a pipe to `receive`, until all its writers are gone; closes it.

    A process that prints blocks while nobody reads, so lines that come too fast are counted and dropped, and if
    `receive` raises `OSError`, as a closed stderr does, the rest is read and dropped.
    """
    filter_ = _LineFilter(receive)
    with os.fdopen(read_end, "rb") as pipe:
        while line := pipe.readline(MAX_LINE_BYTES):
            filter_.line(line.decode(errors="replace"))
    filter_.end()


class _LineFilter:
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
        # Many environments print the same line; once is enough.
        if text == self._last or text.startswith("pybullet build time"):
            return
        # PyBullet's warnings have two lines, the second of which says what is wrong.
        if text.startswith(("b3Warning[", "b3Error[")):
            self._bullet_head = text.rstrip()
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
    return "".join(each if each.isprintable() or each == "\t" else "\ufffd" for each in text.rstrip("\r\n"))


def write_stderr(text: str) -> None:
    """Write a line beside what environments print."""
    # Not by print: an environment may have closed or replaced what that writes to.
    with contextlib.suppress(OSError):
        os.write(2, f"{text}\n".encode(errors="replace"))
