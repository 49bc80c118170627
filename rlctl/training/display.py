"""What training shows: a live display on a terminal, plain lines elsewhere. Everything goes to stderr."""

import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Self

from rlctl import output
from rlctl.runs.best import find_best_row
from rlctl.runs.directory import RunDirectory
from rlctl.runs.tables import read_table

_BLOCKS = "▁▂▃▄▅▆▇█"
_ASCII_BLOCKS = "_.-=+*#@"
_CURVE = 200  # points of a curve
_WIDE = 100  # columns of a terminal
_LINE_EVERY_S = 5.0
_LINE_OF_SEGMENT_EVERY_S = 10.0
_LONG_START_S = 10.0  # a phase before the first step that takes longer gets a line


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
    if rate is None:
        return "-"
    return f"{rate:.0%}" if rate in (0, 1) else f"{rate:.1%}"


def duration(seconds: float) -> str:
    """Return a time as m:ss or h:mm:ss."""
    minutes, whole = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{whole:02d}" if hours else f"{minutes}:{whole:02d}"


def format_score(success: float | None, mean_return: float) -> str:
    """Return the success rate, where there is one, and the mean return of episodes as text."""
    rate = "" if success is None else f"success {percent(success)}  "
    return f"{rate}return {mean_return:.2f}"


class Display:
    """Shows the progress of a training as lines for a log, some seconds apart."""

    def __init__(self, title: str, total: int) -> None:
        self.title = title
        self.total = total
        self._first: tuple[float, int] | None = None  # time and steps of the first segment
        self._began = time.monotonic()
        self._steps, self._stage, self._last_line = 0, "", 0.0
        self._long_phase: threading.Timer | None = None

    def __enter__(self) -> Self:
        self.message(self.title)
        return self

    def __exit__(self, *details: Any) -> None:
        self._end_phase()

    def phase(self, text: str) -> None:
        """A phase such as building begins; a log shows those before the first step that take some seconds."""
        self._end_phase()
        if self._first is None:
            self._long_phase = threading.Timer(_LONG_START_S, self.message, (text,))
            self._long_phase.daemon = True
            self._long_phase.start()

    def _end_phase(self) -> None:
        if self._long_phase is not None:
            self._long_phase.cancel()
            self._long_phase = None

    def run_folder(self, run: RunDirectory) -> None:
        """The run's folder is known; the tables of a resumed run hold its earlier rows."""

    def steps(self, steps: int) -> None:
        """`steps` environment steps are done; called after each segment."""
        self._end_phase()
        if self._first is None:
            self._first = (time.monotonic(), steps)
        self._steps = steps

    def playing(self, steps: int) -> None:
        """A segment is being played, and `steps` environment steps have begun; called several times a second."""
        now = time.monotonic()
        self._end_phase()
        if self._first is None:
            self._first = now, steps
        began, first_steps = self._first
        if steps <= self._steps or now - max(began, self._last_line) < _LINE_OF_SEGMENT_EVERY_S:
            return
        self._last_line = now
        rate = (steps - first_steps) / max(now - began, 1e-9)
        self.message(f"{steps:,}/{self.total:,} steps  {rate:,.{0 if rate >= 10 else 1}f} steps/s")

    def time_left(self) -> str:
        """Return the remaining time at the rate so far; empty if unknown."""
        if self._first is None or self._steps <= self._first[1]:
            return ""
        rate = (self._steps - self._first[1]) / max(time.monotonic() - self._first[0], 1e-9)
        return duration(max(self.total - self._steps, 0) / rate)

    def metrics(self, row: Mapping[str, Any]) -> None:
        """An update is done; `row` is its row of `metrics.csv`."""
        now = time.monotonic()
        if now - self._last_line < _LINE_EVERY_S:
            return
        self._last_line = now
        parts = [f"{row['steps']:,}/{self.total:,} steps", f"{row['fps']:,.0f} steps/s", self._stage]
        if row["success"] is not None:
            parts.append(f"success {percent(row['success'])}")
        if row["return"] is not None:
            parts.append(f"return {row['return']:.2f}")
        if left := self.time_left():
            parts.append(f"{left} left")
        self.message("  ".join(part for part in parts if part))

    def stage(self, title: str, why: str = "") -> None:
        """A stage of the curriculum begins or is resumed."""
        self._stage = title.partition(":")[0]
        self.message(_format_stage(title, why))

    def evaluation(self, steps: int, success: float | None, mean_return: float, best: bool) -> None:
        """An evaluation is done."""
        self.message(_format_evaluation(steps, success, mean_return, best))

    def message(self, text: str) -> None:
        """Show a warning, or output of an environment; if stderr was closed (`| head`), interrupt the training."""
        try:
            print(f"{text}\n", end="", file=sys.stderr, flush=True)  # one write: no line of a library comes in between
        except BrokenPipeError:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), sys.stderr.fileno())
            if callable(stop := signal.getsignal(signal.SIGTERM)):
                stop(signal.SIGPIPE, None)


def _format_stage(title: str, why: str) -> str:
    return f"{title}  ({why})" if why else title


def _format_evaluation(steps: int, success: float | None, mean_return: float, best: bool) -> str:
    return f"eval at {steps:,}: {format_score(success, mean_return)}{'  best' if best else ''}"


class LiveDisplay(Display):
    """A progress bar with curves; messages scroll above it."""

    def __init__(self, title: str, total: int) -> None:
        super().__init__(title, total)
        from rich.live import Live

        self._phase: tuple[str, float] | None = None
        self._folder = ""
        self._fps = 0.0
        self._terms: dict[str, float] = {}
        self._curves: dict[str, deque[float]] = {name: deque(maxlen=_CURVE) for name in ("success", "return")}
        self._evaluations: list[tuple[int, float | None, float, bool]] = []
        self._live = Live(self, console=output.err(), refresh_per_second=8, transient=False, redirect_stdout=False)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *details: Any) -> None:
        self._phase = None
        self._live.__exit__(*details)

    def phase(self, text: str) -> None:
        """Show `text` and its elapsed time until the next step, metrics or evaluation."""
        self._phase = text, time.monotonic()

    def run_folder(self, run: RunDirectory) -> None:
        """Show the folder; draw the earlier rows of a resumed run."""
        self._folder = str(run.path)
        for row in read_table(run.metrics_file):
            self._add_to_curves(row)
        evaluations = read_table(run.evals_file)
        best = find_best_row(evaluations)
        for row in evaluations:
            steps, mean = row.get("steps"), row.get("return")
            if steps is not None and mean is not None:
                self.evaluation(int(steps), row.get("success"), mean, row is best)

    def steps(self, steps: int) -> None:
        """Move the bar to `steps`, the environment steps so far."""
        super().steps(steps)
        self._phase = None

    def playing(self, steps: int) -> None:
        """Move the bar inside a segment."""
        if steps > self._steps:
            self.steps(steps)

    def metrics(self, row: Mapping[str, Any]) -> None:
        """Draw a row of `metrics.csv`: speed, curves and reward terms."""
        self._phase = None
        self._steps, self._fps = row["steps"], row["fps"]
        self._add_to_curves(row)
        terms = {key.removeprefix("term/"): value for key, value in row.items() if key.startswith("term/")}
        self._terms.update({name: value for name, value in terms.items() if value is not None})

    def _add_to_curves(self, row: Mapping[str, Any]) -> None:
        for name, curve in self._curves.items():
            if row.get(name) is not None:
                curve.append(row[name])

    def stage(self, title: str, why: str = "") -> None:
        """Show the stage of the curriculum."""
        self._stage = _format_stage(title, why)

    def evaluation(self, steps: int, success: float | None, mean_return: float, best: bool) -> None:
        """Add an evaluation to the list, of which the last five are shown."""
        self._phase = None
        self._evaluations.append((steps, success, mean_return, best))

    def message(self, text: str) -> None:
        """Print a line above the bar."""
        self._live.console.print(text, markup=False, highlight=False, emoji=False)

    def __rich_console__(self, console: Any, options: Any) -> Any:
        """Draw for a terminal of this width."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        width = options.max_width
        bar = Table.grid(padding=(0, 1))
        bar.add_row(
            Text(self.title, style="bold"),
            ProgressBar(total=self.total, completed=min(self._steps, self.total), width=max(width - 85, 30)),
            f"{self._steps:,}/{self.total:,}",
            f"{self._fps:,.0f} steps/s",
            *([f"{duration(time.monotonic() - self._began)} elapsed"] if width >= _WIDE else []),
            f"{self.time_left() or '-:--'} left",
        )
        yield bar
        if self._folder and width >= _WIDE:
            yield Text(f"  {self._folder}", no_wrap=True, overflow="ellipsis")
        if self._phase is not None:
            text, since = self._phase
            yield Text(f"  {text} ... {duration(time.monotonic() - since)}", style="yellow")
        if self._stage:
            yield Text(f"  {self._stage}")
        successes, returns = ([*curve][-max(width - 30, 32) :] for curve in self._curves.values())
        if successes:
            curve = sparkline(successes, 0.0, 1.0)
            yield Text.assemble("  success ", (curve, "green"), f" {percent(successes[-1])}")
        if returns:
            yield Text.assemble("  return  ", (sparkline(returns), "cyan"), f" {returns[-1]:.2f}")
        if self._terms and width >= _WIDE:
            terms = "  ".join(f"{name} {value:.4g}" for name, value in self._terms.items())
            yield Text(f"  terms   {terms}", no_wrap=True, overflow="ellipsis")
        mark = "✓" if output.is_utf8() else "+"
        for evaluation in self._evaluations[-5:]:
            yield Text(f"  {mark} {_format_evaluation(*evaluation)}", style="green" if evaluation[3] else "")


def make_display(title: str, total: int) -> Display:
    """Return the display for this stderr."""
    return (LiveDisplay if sys.stderr.isatty() else Display)(title, total)
