"""The clock that time limits run on: a busy machine judges what an idle one does, and only takes longer.

It stands still while a process could run and has to wait for a processor. Linux counts that, in `schedstat`; elsewhere
it is the time that passes.
"""

import time
from pathlib import Path

INTERVAL_S = 0.01
"""How often the count is read at most: an episode's step can take much less time than reading it."""


def read_clock() -> float:
    """Return the time of this process [s]; only differences have a meaning."""
    now = time.monotonic()
    if now - _last.read_at > INTERVAL_S:
        _last.read_at, _last.waited_s = now, read_waited_s("self")
    return now - _last.waited_s


def read_clock_of(pid: int) -> float:
    """Return the time of another process [s]; only differences have a meaning."""
    return time.monotonic() - read_waited_s(str(pid))


def read_waited_s(process: str = "self") -> float:
    """Return for how long a process, given by its id, has waited for a processor [s]; 0 where that is not counted."""
    try:
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError):
        return 0.0


class _Last:
    read_at = float("-inf")
    waited_s = 0.0


_last = _Last()
