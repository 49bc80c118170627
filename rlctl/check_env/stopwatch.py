"""Times calls on a machine on which other processes run too."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rlctl.check_env.call_times import Calls, CallTimes, merged

CALM = 0.02
"""A call that waited for a processor for a smaller part of its time was not disturbed."""
_SCHEDULER = Path("/proc/thread-self/schedstat")


def waited_s() -> float:
    """Return for how long this thread could have run, so far, but others had the processors; 0 where no one counts."""
    try:
        return int(_SCHEDULER.read_bytes().split()[1]) / 1e9
    except (OSError, ValueError, IndexError):
        return 0.0


class Stopwatch:
    """Calls functions and notes how long they take."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        """Per call, without the time in which it waited for a processor."""

    def __call__(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call the function and return what it returns."""
        waited = waited_s()
        started = time.perf_counter()
        value = function(*arguments, **keywords)
        ended = time.perf_counter()
        self.seconds.append(max(0.0, ended - started - (waited_s() - waited)))
        return value


class CallWatch:
    """Calls functions and notes which calls they make and how long each takes."""

    def __init__(self, is_own: Callable[[str], bool], kind_of: Callable[[str, bool], str]) -> None:
        self._is_own, self._kind_of = is_own, kind_of
        self._runs: list[tuple[float, CallTimes]] = []

    def __call__(self, function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        """Call the function and return what it returns."""
        times = CallTimes(self._is_own, self._kind_of)
        waited, started = waited_s(), time.perf_counter()
        value = times(function, *arguments, **keywords)
        taken = time.perf_counter() - started
        self._runs.append(((waited_s() - waited) / taken, times))
        return value

    @property
    def error(self) -> Exception | None:
        """What the watch itself raised."""
        return next((times.error for _, times in self._runs if times.error), None)

    @property
    def runs(self) -> list[CallTimes]:
        """The calls that were not disturbed; where most were, the half that was disturbed least.

        A break of a millisecond looks like a slow call: it falls into one of them, whichever.
        """
        ordered = sorted(self._runs, key=lambda run: run[0])
        calm = sum(waited < CALM for waited, _ in ordered)
        return [times for _, times in ordered[: max(calm, (len(ordered) + 1) // 2)]]

    @property
    def seconds(self) -> float:
        """How long the preserve_process_state calls took together."""
        return sum(times.seconds for times in self.runs)

    def slowest(self) -> list[Calls]:
        """Return every function, by its own time, the slowest first; those called from several places added up."""
        return merged((calls for times in self.runs for calls in times.calls), lambda calls: calls.own_s)

    def suspicious(self) -> list[Calls]:
        """Return the suspicious calls that no other such call contains, the slowest first."""
        calls = (calls for times in self.runs for calls in times.calls if calls.whole_count)
        return merged(calls, lambda calls: calls.whole_s)
