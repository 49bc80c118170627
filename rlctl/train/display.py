"""What training shows: a live display on a terminal, plain lines elsewhere. Everything goes to stderr."""

from __future__ import annotations

import abc
import sys
import time
from collections import deque
from typing import Any

from rlctl import output

_BLOCKS = "▁▂▃▄▅▆▇█"
_CURVE = 32  # points
_LINE_EVERY_S = 5.0


def sparkline(values: list[float], low: float | None = None, high: float | None = None) -> str:
    """Draw values as a line of blocks, between `low` and `high` or their own range."""
    if not values:
        return ""
    low = min(values) if low is None else low
    high = max(values) if high is None else high
    scale = (len(_BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(_BLOCKS[round(min(max((value - low) * scale, 0), len(_BLOCKS) - 1))] for value in values)


def percent(rate: float | None) -> str:
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

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: object) -> None:
        return

    @abc.abstractmethod
    def steps(self, steps: int) -> None:
        """So many environment steps are done; called after each step of all environments."""

    @abc.abstractmethod
    def metrics(self, steps: int, fps: float, mean_return: float | None, success: float | None) -> None:
        """An update is done."""

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
    return f"{title}  ({why})" if why else title


def evaluation_line(steps: int, success: float | None, mean_return: float, best: bool) -> str:
    rate = "" if success is None else f"success {percent(success)}  "
    return f"eval at {steps:,}: {rate}return {mean_return:.2f}{'  best' if best else ''}"


class PlainDisplay(Display):
    """A line every few seconds, for logs."""

    def __init__(self, title: str, total: int) -> None:
        super().__init__(title, total)
        self._last_line = 0.0
        self._stage = ""
        self._started: tuple[float, int] | None = None

    def __enter__(self) -> Display:
        self._print(self.title)
        return self

    def steps(self, steps: int) -> None:
        if self._started is None:
            self._started = (time.monotonic(), steps)

    def metrics(self, steps: int, fps: float, mean_return: float | None, success: float | None) -> None:
        now = time.monotonic()
        if now - self._last_line < _LINE_EVERY_S:
            return
        self._last_line = now
        parts = [f"{steps:,}/{self.total:,} steps", f"{fps:,.0f} steps/s"]
        if self._stage:
            parts.append(self._stage)
        if success is not None:
            parts.append(f"success {percent(success)}")
        if mean_return is not None:
            parts.append(f"return {mean_return:.2f}")
        if self._started is not None and steps > self._started[1]:
            rate = (steps - self._started[1]) / max(now - self._started[0], 1e-9)
            parts.append(f"{duration(max(self.total - steps, 0) / rate)} left")
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

        self._steps = 0
        self._fps = 0.0
        self._stage = ""
        self._returns: deque[float] = deque(maxlen=_CURVE)
        self._successes: deque[float] = deque(maxlen=_CURVE)
        self._evaluations: list[tuple[int, float | None, float, bool]] = []
        self._started: tuple[float, int] | None = None
        self._live = Live(self, console=output.err(), refresh_per_second=8, transient=False)

    def __enter__(self) -> Display:
        self._live.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        self._live.__exit__(*details)

    def steps(self, steps: int) -> None:
        if self._started is None:
            self._started = (time.monotonic(), steps)
        self._steps = steps

    def metrics(self, steps: int, fps: float, mean_return: float | None, success: float | None) -> None:
        self._steps, self._fps = steps, fps
        if mean_return is not None:
            self._returns.append(mean_return)
        if success is not None:
            self._successes.append(success)

    def stage(self, title: str, why: str = "") -> None:
        self._stage = stage_line(title, why)

    def evaluation(self, steps: int, success: float | None, mean_return: float, best: bool) -> None:
        self._evaluations.append((steps, success, mean_return, best))

    def message(self, text: str) -> None:
        from rich.text import Text

        self._live.console.print(Text(text))

    def _time_left(self) -> str:
        if self._started is None or self._steps <= self._started[1]:
            return "-:--"
        rate = (self._steps - self._started[1]) / max(time.monotonic() - self._started[0], 1e-9)
        return duration(max(self.total - self._steps, 0) / rate)

    def __rich__(self) -> Any:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        bar = Table.grid(padding=(0, 1))
        bar.add_row(
            Text(self.title, style="bold"),
            ProgressBar(total=self.total, completed=min(self._steps, self.total), width=30),
            f"{self._steps:,}/{self.total:,}",
            f"{self._fps:,.0f} steps/s",
            f"{self._time_left()} left",
        )
        lines: list[Any] = [bar]
        if self._stage:
            lines.append(Text(f"  {self._stage}"))
        if self._successes:
            curve = sparkline(list(self._successes), 0.0, 1.0)
            lines.append(Text.assemble("  success ", (curve, "green"), f" {percent(self._successes[-1])}"))
        if self._returns:
            curve = sparkline(list(self._returns))
            lines.append(Text.assemble("  return  ", (curve, "cyan"), f" {self._returns[-1]:.2f}"))
        for each in self._evaluations[-5:]:
            lines.append(Text("  ✓ " + evaluation_line(*each), style="green" if each[3] else ""))
        return Group(*lines)


def make_display(title: str, total: int) -> Display:
    """Return the display for this stderr."""
    return LiveDisplay(title, total) if sys.stderr.isatty() else PlainDisplay(title, total)
