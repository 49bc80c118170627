"""Where results and messages go: results to stdout, everything else to stderr."""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import math
import os
import re
import stat
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rlctl.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Console, JustifyMethod
    from rich.text import Text

_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # all but tab and newline
_PIPED_WIDTH = 1000  # nothing folds: a line stays a line for grep


@functools.cache
def results() -> TextIO:
    """Return the stream of results, the original stdout. From then on descriptor 1 is stderr, for other output."""
    try:
        sys.stdout.flush()
        # A terminal has its own encoding; files and pipes get UTF-8.
        encoding = sys.stdout.encoding if sys.stdout.isatty() else "utf-8"
        stream = os.fdopen(os.dup(1), "w", encoding=encoding, errors="replace")
    except (OSError, AttributeError):  # started without a stdout
        raise BrokenPipeError from None
    os.dup2(2, 1)
    return stream


def leave_closed_terminal() -> None:
    """Redirect the streams of a terminal that was closed to /dev/null; writing to them would fail."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    own = [results().fileno()] if results.cache_info().currsize else []
    for descriptor in (0, 1, 2, *own):
        with contextlib.suppress(OSError):  # not open
            # After the terminal is closed, the descriptor is still a character device, but isatty() is False.
            if stat.S_ISCHR(os.fstat(descriptor).st_mode) and not os.isatty(descriptor):
                os.dup2(nowhere, descriptor)
    os.close(nowhere)


@functools.cache
def out() -> Console:
    """Return the console for results."""
    return _make_console(results())


@functools.cache
def err() -> Console:
    """Return the console for progress, logs and errors."""
    return _make_console(None)


def escape_controls(text: str) -> str:
    """Return text with control characters escaped as `\\x1b`: names may contain some, and terminals execute them."""
    return _CONTROLS.sub(lambda match: f"\\x{ord(match[0]):02x}", text)


def _make_console(stream: TextIO | None) -> Console:
    """Return a console for a stream; for None it writes to the current stderr, which a notebook may replace."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class SafeConsole(Console):
        """Escapes the control characters of any text that is printed."""

        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
            for segment in super().render(renderable, options):
                yield segment if segment.control else Segment(escape_controls(segment.text), segment.style)

    terminal = (stream or sys.stderr).isatty()
    width = None if terminal else _PIPED_WIDTH
    # No markup and no emoji: "car.py:Car:" contains an emoji name, and "joint[left]" a markup tag.
    # Results have no hard line breaks: commands in them can be copied.
    soft_wrap = not terminal or stream is not None
    options: dict[str, Any] = {"markup": False, "highlight": False, "emoji": False, "soft_wrap": soft_wrap}
    return SafeConsole(file=stream, stderr=stream is None, width=width, **options)


def is_utf8() -> bool:
    """Return whether stderr, which shows progress, can show more than ASCII."""
    return (getattr(sys.stderr, "encoding", None) or "").lower().startswith("utf")


def confirm(question: str, refusal: str) -> bool:
    """Ask on the terminal; raises `UsageError(refusal)` without a terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        raise UsageError(refusal)
    import typer

    return typer.confirm(question, err=True)


def show_progress(
    what: str, total: int | None = None, unit: str = ""
) -> contextlib.AbstractContextManager[Callable[[int], None]]:
    """Show the progress of work that may take longer than a few seconds, with the time that is left.

    Yields a function that takes how many of `total` are done, in `unit` (`episodes`); without `total` only the time is
    shown. On a terminal it is a bar, elsewhere a line on stderr after `_FIRST_LINE_S`, and then now and then.
    """
    display = _show_bar if err().is_terminal else _print_lines_of_progress
    return display(what, total, unit)


@contextlib.contextmanager
def _show_bar(what: str, total: int | None, unit: str) -> Iterator[Callable[[int], None]]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns: list[ProgressColumn] = [TextColumn("{task.description}"), BarColumn()]
    if total is None:
        columns.append(TimeElapsedColumn())
    else:
        columns += [MofNCompleteColumn(" of "), TextColumn(unit), TimeRemainingColumn(), TextColumn("left")]
    with Progress(*columns, console=err(), transient=True, redirect_stdout=False) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.update(task, completed=done)


_FIRST_LINE_S = 10.0  # [s]
_LEAST_S = 0.5  # [s]; shorter work prints no line, however long the silence before it was
_PAUSE_S = 5.0  # [s]; work that follows sooner continues the silence before it: ten calls of 9 s are 90 s
_LINES_S = (20.0, 30.0)  # [s] between further lines; the last one from then on


class _Silence:
    """When work began of which no line was printed yet, and when the last one ended [s, monotonic]."""

    began = ended = -math.inf


_silence = _Silence()


@contextlib.contextmanager
def _print_lines_of_progress(what: str, total: int | None, unit: str) -> Iterator[Callable[[int], None]]:
    """A thread prints the lines: a single call, as of a compiler, may take minutes."""
    start, done, ended = time.monotonic(), 0, threading.Event()
    if start - _silence.ended > _PAUSE_S:
        _silence.began = start

    def show(count: int) -> None:
        nonlocal done
        done = count

    def print_now_and_then() -> None:
        first = max(_LEAST_S, _FIRST_LINE_S - (start - _silence.began))
        for wait in itertools.chain((first,), _LINES_S, itertools.repeat(_LINES_S[-1])):
            if ended.wait(wait):
                return
            _silence.began = time.monotonic()
            with contextlib.suppress(OSError, ValueError):  # nobody reads stderr any more
                print_notes([format_progress(what, done, total, unit, time.monotonic() - start)])

    printer = threading.Thread(target=print_now_and_then, name="progress", daemon=True)
    printer.start()
    try:
        yield show
    finally:
        ended.set()
        printer.join()
        _silence.ended = time.monotonic()


def format_progress(what: str, done: int, total: int | None, unit: str, seconds: float) -> str:
    """Format progress after a time [s]: `filming: 60 of 900 steps, about 3 min left`, or `compiling: 12 s so far`."""
    if total is None:
        return f"{what}: {format_duration(seconds)} so far"
    counted = f"{what}: {done:,} of {total:,} {unit}".rstrip()
    if done <= 0:
        return f"{counted}, {format_duration(seconds)} so far"
    return f"{counted}, about {format_duration(seconds * max(total - done, 0) / done)} left"


def format_duration(seconds: float) -> str:
    """Format a time [s]: `50 s`, `12 min`, `3.4 h`, `2.5 days`."""
    for size, unit in ((86_400, "days"), (3600, "h")):
        if seconds >= size:
            return f"{round(seconds / size, 1):g} {unit}"
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.0f} s"


def format_count(count: int, noun: str) -> str:
    """Format a number with a noun: `1 episode`, `2,000 episodes`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def print_notes(notes: Iterable[str]) -> None:
    """Print lines to stderr."""
    for note in notes:
        err().print(note, style="dim", soft_wrap=True)  # commands can be copied


def show_foreign(text: str) -> None:
    """Show a line that an environment or a library has printed: dimmed on a terminal, above a progress display."""
    if sys.stderr.isatty():
        err().print(text, style="dim", soft_wrap=True)
    else:
        sys.stderr.write(f"{text}\n")  # at once: the end of a line that is written later may come after another line
        sys.stderr.flush()


Cells = Sequence["str | Text"]


def print_table(
    columns: Sequence[str],
    rows: Iterable[Cells],
    *,
    left: Collection[str] = (),
    drop: Sequence[str] = (),
    gap: str = "  ",
) -> None:
    """Print a table of results, with columns aligned right except those in `left`. Cells are plain text, not markup.

    A table without column names has no header. If the terminal is too narrow, the columns in `drop` are left out one by
    one, in this order. If the table is still too wide, texts after the first column are folded, then all other cells.
    """
    from rich.text import Text

    table = [[Text(name, style="bold") for name in columns]] if any(columns) else []
    table += [[cell if isinstance(cell, Text) else Text(cell) for cell in row] for row in rows]
    names, to_drop = list(columns), list(drop)
    while to_drop and _measure_width(table, names, left, gap) > out().width:
        number = names.index(to_drop.pop(0))
        names.pop(number)
        table = [row[:number] + row[number + 1 :] for row in table]
    if sum(_measure_columns(table)) + len(gap) * (len(names) - 1) > out().width:
        _print_folded(table, names, left, gap)
    else:
        _print_lines(table, names, left, gap)


def _measure_columns(table: Sequence[Sequence[Text]]) -> list[int]:
    return [max(cell.cell_len for cell in column if cell is not None) for column in itertools.zip_longest(*table)]


_FOLDED_TEXT = 24  # width to which texts may be folded before columns are dropped


def _measure_width(table: Sequence[Sequence[Text]], names: Sequence[str], left: Collection[str], gap: str) -> int:
    """Return the width of a table whose long texts are folded."""
    widths = zip(names, _measure_columns(table), strict=True)
    folded = [min(w, _FOLDED_TEXT) if name in left and name != names[0] else w for name, w in widths]
    return sum(folded) + len(gap) * (len(names) - 1)


def _print_folded(table: list[list[Text]], names: list[str], left: Collection[str], gap: str) -> None:
    from rich.table import Table

    folded = Table(box=None, pad_edge=False, padding=(0, len(gap) // 2), show_header=False)
    texts = [name in left and name != names[0] for name in names]
    widths = zip(_measure_columns(table), texts, strict=True)
    rigid = sum(width for width, is_text in widths if not is_text) + len(gap) * len(names)
    fits = rigid + 8 * sum(texts) <= out().width
    for name, is_text in zip(names, texts, strict=True):
        justify: JustifyMethod = "left" if name in left else "right"
        folded.add_column(justify=justify, overflow="fold", no_wrap=fits and not is_text)
    for row in table:
        folded.add_row(*row)
    out().print(folded, soft_wrap=False)


def _print_lines(table: list[list[Text]], names: list[str], left: Collection[str], gap: str) -> None:
    from rich.text import Text

    widths = _measure_columns(table)
    lines = Text()  # rich's own table takes half a second for a thousand rows
    for row in table:
        line = Text()
        for name, width, cell in zip(names, widths, row, strict=False):
            space = " " * (width - cell.cell_len)
            for part in (cell, space) if name in left else (space, cell):
                line.append(part)
            line.append(gap)
        line.rstrip()
        lines.append_text(line.append("\n"))
    out().print(lines, end="")


def present(content: Any, json_target: str | None) -> bool:
    """Write a result as JSON to the target of `--json`: a file, or stdout for `-`; None writes nothing.

    `content` is plain data, dataclasses and paths. Return whether it went to stdout; then print nothing else there.
    """
    if json_target is None:
        return False
    from pydantic_core import to_jsonable_python

    content = to_jsonable_python(content)
    if json_target == "-":
        results().write(json.dumps(content, indent=2, allow_nan=False) + "\n")
        results().flush()
        return True
    from rlctl.storage import files

    files.write_result(Path(json_target), f"{json.dumps(content, indent=2)}\n".encode())
    return False
