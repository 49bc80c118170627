"""What training shows: a live display on a terminal, plain lines elsewhere. Everything goes to stderr."""

from __future__ import annotations

import abc
import csv
import sys
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlctl import output

_BLOCKS = "▁▂▃▄▅▆▇█"
_ASCII_BLOCKS = "_.-=+*#@"
_CURVE = 200  # points that are kept; as many are drawn as there is room for
_WIDE = 100  # columns of a terminal
_LINE_EVERY_S = 5.0


def sparkline(values: list[float], low: float | None = None, high: float | None = None) -> str:
    """Draw values as a line of blocks, between `low` and `high` or their own range."""
    if not values:
        return ""
    blocks = _BLOCKS if output.is_utf8() else _ASCII_BLOCKS
    low = min(values) if low is None else low
    high = max(values) if high is None else high
    scale = (len(blocks) - 1) / (high - low) if high > low else 0.0
    return "".join(blocks[round(min(max((value - low) * scale, 0), len(blocks) - 1))] for value in values)


def percent(rate: float | None) -> str:
    """Return a rate as text: `98.5%`, `-` for none."""
    return "-" if rate is None else f"{rate:.0%}" if rate in (0, 1) else f"{rate:.1%}"


def duration(seconds: float) -> str:
    """Return a time as m:ss or h:mm:ss."""
    minutes, whole = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{whole:02d}" if hours else f"{minutes}:{whole:02d}"


class Display(abc.ABC):
    """Shows what happens in a training."""

    def __init__(self, title: str, total: int) -> None:
        self.title = title
        self.total = total
        self._steps = 0
        self._first: tuple[float, int] | None = None

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def phase(self, text: str) -> None:  # noqa: B027 (a log does without)
        """What is done before the first step, or now, begins: `text` names it."""

    def run_folder(self, folder: Path, metrics: Path, evals: Path) -> None:  # noqa: B027
        """The run's folder is known; of a resumed run the tables hold its earlier rows."""

    def steps(self, steps: int) -> None:
        """So many environment steps are done; called after each segment."""
        if self._first is None:
            self._first = (time.monotonic(), steps)
        self._steps = steps

    def time_left(self) -> str:
        """Return how long the rest takes at the rate so far; empty where that is not known yet."""
        if self._first is None or self._steps <= self._first[1]:
            return ""
        rate = (self._steps - self._first[1]) / max(time.monotonic() - self._first[0], 1e-9)
        return duration(max(self.total - self._steps, 0) / rate)

    @abc.abstractmethod
    def metrics(self, row: Mapping[str, Any]) -> None:
        """An update is done; `row` is that of `metrics.csv`."""

    @abc.abstractmethod
    def stage(self, title: str, why: str = "") -> None:
        """A stage of the curriculum begins, or goes on after a resume."""

    @abc.abstractmethod
    def evaluation(self, steps: int, success: float | None, mean_return: float, best: bool) -> None:
        """An evaluation is done."""

    @abc.abstractmethod
    def message(self, text: str) -> None:
        """Text to show: a warning, or what an environment printed."""


def stage_line(title: str, why: str) -> str:
    """Return the line of a stage that begins."""
    return f"{title}  ({why})" if why else title


def evaluation_line(steps: int, success: float | None, mean_return: float, best: bool) -> str:
    """Return the line of an evaluation."""
    rate = "" if success is None else f"success {percent(success)}  "
    return f"eval at {steps:,}: {rate}return {mean_return:.2f}{'  best' if best else ''}"


class PlainDisplay(Display):
    """A line every few seconds, for logs."""

    def __init__(self, title: str, total: int) -> None:
        super().__init__(title, total)
        self._last_line = 0.0
        self._stage = ""

    def __enter__(self) -> Display:
        self._print(self.title)
        return self

    def metrics(self, row: Mapping[str, Any]) -> None:
        steps, mean_return, success = row["steps"], row["return"], row["success"]
        now = time.monotonic()
        if now - self._last_line < _LINE_EVERY_S:
            return
        self._last_line = now
        parts = [f"{steps:,}/{self.total:,} steps", f"{row['fps']:,.0f} steps/s"]
        if self._stage:
            parts.append(self._stage)
        if success is not None:
            parts.append(f"success {percent(success)}")
        if mean_return is not None:
            parts.append(f"return {mean_return:.2f}")
        if left := self.time_left():
            parts.append(f"{left} left")
        self._print("  ".join(parts))

    def stage(self, title: str, why: str = "") -> None:
        self._stage = title.partition(":")[0]
        self._print(stage_line(title, why))

    def evaluation(self, steps: int, success: float | None, mean_return: float, best: bool) -> None:
        self._print(evaluation_line(steps, success, mean_return, best))

    def message(self, text: str) -> None:
        self._print(text)

    def _print(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)


class LiveDisplay(Display):
    """A progress bar with curves; what others print scrolls above it."""

    def __init__(self, title: str, total: int) -> None:
        super().__init__(title, total)
        from rich.live import Live

        self._began = time.monotonic()
        self._phase: tuple[str, float] | None = None
        self._folder: Path | None = None
        self._fps = 0.0
        self._stage = ""
        self._terms: dict[str, float] = {}
        self._returns: deque[float] = deque(maxlen=_CURVE)
        self._successes: deque[float] = deque(maxlen=_CURVE)
        self._evaluations: list[tuple[int, float | None, float, bool]] = []
        self._live = Live(self, console=output.err(), refresh_per_second=8, transient=False)

    def __enter__(self) -> Display:
        self._live.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        self._phase = None
        self._live.__exit__(*details)

    def phase(self, text: str) -> None:
        self._phase = text, time.monotonic()

    def run_folder(self, folder: Path, metrics: Path, evals: Path) -> None:
        self._folder = folder
        for row in _read_rows(metrics):
            self._add_to_curves(_number(row.get("return")), _number(row.get("success")))
        best = None
        for row in _read_rows(evals):
            steps, success, mean = _number(row.get("steps")), _number(row.get("success")), _number(row.get("return"))
            if steps is not None and mean is not None:
                score = (success or 0.0, mean)
                self.evaluation(int(steps), success, mean, best is None or score > best)
                best = score if best is None else max(best, score)

    def steps(self, steps: int) -> None:
        super().steps(steps)
        self._phase = None

    def metrics(self, row: Mapping[str, Any]) -> None:
        self._phase = None
        self._steps, self._fps = row["steps"], row["fps"]
        self._add_to_curves(row["return"], row["success"])
        terms = {key.removeprefix("term/"): value for key, value in row.items() if key.startswith("term/")}
        self._terms.update({name: value for name, value in terms.items() if value is not None})

    def _add_to_curves(self, mean_return: float | None, success: float | None) -> None:
        if mean_return is not None:
            self._returns.append(mean_return)
        if success is not None:
            self._successes.append(success)

    def stage(self, title: str, why: str = "") -> None:
        self._stage = stage_line(title, why)

    def evaluation(self, steps: int, success: float | None, mean_return: float, best: bool) -> None:
        self._phase = None
        self._evaluations.append((steps, success, mean_return, best))

    def message(self, text: str) -> None:
        from rich.text import Text

        self._live.console.print(Text(text))

    def __rich_console__(self, console: Any, options: Any) -> Any:
        """Draw for a terminal of this width."""
        yield self._bar(options.max_width)
        yield from self._lines(options.max_width)

    def _bar(self, width: int) -> Any:
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        wide = width >= _WIDE
        bar = Table.grid(padding=(0, 1))
        elapsed = f"{duration(time.monotonic() - self._began)} elapsed" if wide else ""
        bar.add_row(
            Text(self.title, style="bold"),
            ProgressBar(total=self.total, completed=min(self._steps, self.total), width=max(width - 85, 30)),
            f"{self._steps:,}/{self.total:,}",
            f"{self._fps:,.0f} steps/s",
            *([elapsed] if wide else []),
            f"{self.time_left() or '-:--'} left",
        )
        return bar

    def _lines(self, width: int) -> list[Any]:
        from rich.text import Text

        lines: list[Any] = []
        if self._folder is not None and width >= _WIDE:
            lines.append(Text(f"  {self._folder}", no_wrap=True, overflow="ellipsis"))
        if self._phase is not None:
            text, since = self._phase
            lines.append(Text(f"  {text} ... {duration(time.monotonic() - since)}", style="yellow"))
        if self._stage:
            lines.append(Text(f"  {self._stage}"))
        points = max(width - 30, 32)
        if self._successes:
            curve = sparkline(list(self._successes)[-points:], 0.0, 1.0)
            lines.append(Text.assemble("  success ", (curve, "green"), f" {percent(self._successes[-1])}"))
        if self._returns:
            curve = sparkline(list(self._returns)[-points:])
            lines.append(Text.assemble("  return  ", (curve, "cyan"), f" {self._returns[-1]:.2f}"))
        if self._terms and width >= _WIDE:
            terms = "  ".join(f"{name} {value:.4g}" for name, value in self._terms.items())
            lines.append(Text(f"  terms   {terms}", no_wrap=True, overflow="ellipsis"))
        for each in self._evaluations[-5:]:
            lines.append(
                Text(
                    ("  ✓ " if output.is_utf8() else "  + ") + evaluation_line(*each), style="green" if each[3] else ""
                )
            )
        return lines


def _read_rows(table: Path) -> list[dict[str, str]]:
    """Return the last rows of a table of the run; none if it is not there yet, or cannot be read."""
    try:
        with table.open(newline="", encoding="utf-8", errors="replace") as file:
            return list(deque(csv.DictReader(file), maxlen=_CURVE))
    except (OSError, csv.Error):
        return []


def _number(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None


def make_display(title: str, total: int) -> Display:
    """Return the display for this stderr."""
    return LiveDisplay(title, total) if sys.stderr.isatty() else PlainDisplay(title, total)
