"""What environments and libraries print, in all processes: each line is shown once, dimmed, and repeats are counted.

A line of theirs has no escape codes and never cuts one of rlctl's.
"""

import contextlib
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from rlctl import output
from rlctl.errors import short_repr

MAX_LINE_BYTES = 1000  # bytes
MAX_LINES_PER_S = 100
MAX_LOG_BYTES = 10 * 2**20
_MOST_KNOWN = 1000  # lines whose repeats are counted
_MOST_EARLY = 10_000  # lines that wait for their file
_MOST_GROUPS = 3  # of lines that were printed equally often, in one report
_ESCAPE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)|[@-Z\\-_])")
_NOISE = ("pybullet build time", "argv[0]=")
"""Lines of PyBullet without content: of its import, and of every connection."""
_BULLET_HEAD = re.compile(r"(b3(?:Warning|Error)\[)(?:[^\],]*/)?([^\]]*\]:)$")
"""PyBullet's warnings begin with a line, and end without a line break: the next one begins in their last line."""


def remove_escape_codes(text: str) -> str:
    """Return a text without the codes for colors, cursor and titles of terminals."""
    return _ESCAPE.sub("", text)


def clean(text: str) -> str:
    """Return a line without escape codes and other control characters; empty if it says nothing."""
    text = remove_escape_codes(text).rstrip()
    if text.startswith(_NOISE):
        return ""
    return "".join(char if char.isprintable() or char == "\t" else "\ufffd" for char in text)


class PrintedLines:
    """Passes each line to `show` once, counts its repeats, and writes all of them to a file once there is one.

    A printing process blocks while nobody reads, so of more than 100 new lines per second the others are counted and
    not shown. None is shown after `show` raises `OSError`, as a closed stderr does. May be called from any thread.
    """

    def __init__(self, show: Callable[[str], None] = output.show_foreign) -> None:
        self._show = show
        self._lock = threading.RLock()
        self._closed = False
        self._counts: dict[str, int] = {}
        self._reported: dict[str, int] = {}
        self._second = self._lines = self._left_out = 0  # new lines in this second
        self._early: deque[str] = deque(maxlen=_MOST_EARLY)
        self._log: Path | None = None
        self._file: BinaryIO | None = None
        self._log_bytes = 0

    def line(self, text: str) -> None:
        """Take a line."""
        if not (text := clean(text)):
            return
        with self._lock:
            self._early.append(text)
            self._write_log()
            self._counts[text] = count = self._counts.pop(text, 0) + 1  # the last one printed comes last
            if count == 1:
                self._show_new(text)

    def open_reader(self) -> "LineReader":
        """Return a reader of a process's lines, of at most 1000 bytes; it reads PyBullet's warnings whole."""
        head = ""

        def receive(text: str) -> None:
            nonlocal head
            next_head = _BULLET_HEAD.search(text)
            if content := text[: next_head.start()] if next_head else text:
                self.line(head + content)
            head = f"{next_head[1]}{next_head[2]} " if next_head else ""

        return LineReader(receive, MAX_LINE_BYTES)

    def _show_new(self, text: str) -> None:
        if len(self._counts) > _MOST_KNOWN:
            oldest = next(iter(self._counts))
            del self._counts[oldest]
            self._reported.pop(oldest, None)
        second = int(time.monotonic())
        if second != self._second:
            self.report_left_out()
            self._second, self._lines = second, 0
        self._lines += 1
        if self._lines > MAX_LINES_PER_S:
            self._left_out += 1
        else:
            self._pass_on(text)

    def log_to(self, file: Path) -> None:
        """Write all lines to a file too, of at most 10 MiB, those so far included. It appears with the first line."""
        with self._lock:
            self._log = file
            with contextlib.suppress(OSError):  # of a resumed training
                self._log_bytes = file.stat().st_size
            self._write_log()

    def _write_log(self) -> None:
        if self._log is None or not self._early:
            return
        content = "".join(f"{text}\n" for text in self._early).encode(errors="replace")
        self._early.clear()
        if self._log_bytes > MAX_LOG_BYTES:
            return
        self._log_bytes += len(content)
        if self._log_bytes > MAX_LOG_BYTES:
            content += b"(more lines are left out)\n"
        with contextlib.suppress(OSError):  # a full disk stops the training where its results are written
            self._file = self._file or open(self._log, "ab", buffering=0)  # noqa: SIM115 (`end` closes it)
            self._file.write(content)

    def report(self) -> None:
        """Show how often each repeated line was printed, if that has more than doubled since the last report."""
        with self._lock:
            groups: dict[int, list[str]] = {}
            for text, count in self._counts.items():
                if count > 2 * self._reported.get(text, 0) and count > 1:
                    groups.setdefault(count, []).append(text)
                    self._reported[text] = count
            where = "" if self._log is None else f"; all lines: {self._log}"
            for count, (first, *others) in sorted(groups.items(), reverse=True)[:_MOST_GROUPS]:
                more = f" and {output.format_count(len(others), 'other line')}" if others else ""
                self._pass_on(f"({count:,} times{' each' * bool(others)}: {short_repr(first, 60)}{more}{where})")
                where = ""

    def report_left_out(self) -> None:
        """Show how many new lines came too fast to be shown, if any."""
        with self._lock:
            if self._left_out:
                self._pass_on(f"({self._left_out:,} more lines printed by environments are left out)")
            self._left_out = 0

    def end(self) -> None:
        """Report what was not shown, and close the file."""
        self.report_left_out()
        self.report()
        with self._lock, contextlib.suppress(OSError):
            if self._file is not None:
                self._file.close()
            self._log = self._file = None

    def _pass_on(self, text: str) -> None:
        try:
            if not self._closed:
                self._show(text)
        except (OSError, ValueError, AttributeError):  # closed, or not there
            self._closed = True


_collecting: list[PrintedLines] = []  # of this process; the last one is used


def current() -> PrintedLines | None:
    """Return what takes the lines of this process and its workers; None outside of `collect`."""
    return _collecting[-1] if _collecting else None


@contextlib.contextmanager
def collect() -> Iterator[PrintedLines]:
    """Take the lines of all workers that are started meanwhile together, and report repeats at the end."""
    if (outer := current()) is not None:
        yield outer
        return
    printed = PrintedLines()
    _collecting.append(printed)
    try:
        yield printed
    finally:
        _collecting.pop()
        printed.end()


def print_line(text: str) -> None:
    """Print a line for a library, even if an environment has closed or replaced `sys.stderr`."""
    if (printed := current()) is not None:
        printed.line(text)
    else:
        with contextlib.suppress(OSError):
            os.write(2, f"{text}\n".encode(errors="replace"))


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
