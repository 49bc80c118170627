"""Time limits run on a clock that stands still while a process waits for a processor."""

import time
from pathlib import Path

import pytest

from rlctl.checking.progress import INTERVAL_S, read_clock, read_clock_of

LINUX = pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="only Linux counts it")


def test_waiting_for_something_else_counts():
    before, begun = read_clock(), time.monotonic()
    time.sleep(0.3)
    # The count of what does not count is read so often only.
    assert 0.3 - INTERVAL_S <= read_clock() - before <= time.monotonic() - begun + INTERVAL_S


@LINUX
def test_waiting_for_a_processor_does_not_count(busy):
    before, begun = [read_clock_of(child.pid) for child in busy], time.monotonic()
    time.sleep(0.6)
    spent = [read_clock_of(child.pid) - then for child, then in zip(busy, before, strict=True)]
    assert sum(spent) < 2 * (time.monotonic() - begun)  # one processor for three: each has a third of it, or less
