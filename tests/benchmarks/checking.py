"""How long check-env takes, and how much memory: of all its processes together."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

import psutil

from tests.benchmarks.row import Row

SAMPLE_S = 0.02
LIMIT_MB = 400


def bundled_task(repeat: int) -> Row:
    """All rules on reach."""
    runs = [_measured("reach") for _ in range(repeat)]
    seconds = statistics.median(run[0] for run in runs)
    memory = max(run[1] for run in runs)
    return Row(
        "check-env reach",
        f"{seconds:.1f} s, {memory:.0f} MB",
        "-",
        "-",
        f"< 30 s, < {LIMIT_MB} MB",
        seconds < 30 and memory < LIMIT_MB,
        f"all rules; process start to end; the most memory at any time of {repeat} runs, summed over all processes, "
        "what they share counted once",
    )


def cart_pole(repeat: int) -> Row:
    """All rules on CartPole."""
    return _row("check-env CartPole-v1", ["CartPole-v1"], 10.0, repeat)


def determinism(repeat: int) -> Row:
    """One family on reach."""
    return _row("check-env reach --select RL3", ["reach", "--select", "RL3"], 5.0, repeat)


def _row(what: str, arguments: list[str], limit_s: float, repeat: int) -> Row:
    seconds = statistics.median(_measured(*arguments)[0] for _ in range(repeat))
    return Row(what, f"{seconds:.1f} s", "-", "-", f"< {limit_s:.0f} s", seconds < limit_s, "process start to end")


def _measured(*arguments: str) -> tuple[float, float]:
    """Return seconds and the largest memory of a check, the latter as the sum of proportional set sizes [MB]."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "rlctl", "check-env", *arguments]
    process = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    largest = 0.0
    while process.poll() is None:
        largest = max(largest, _memory(process))
        time.sleep(SAMPLE_S)
    if process.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(arguments)}: exit code {process.returncode}")
    return time.perf_counter() - began, largest


def _memory(process: psutil.Process) -> float:
    total = 0
    try:
        for each in [process, *process.children(recursive=True)]:
            total += each.memory_full_info().pss
    except psutil.NoSuchProcess:  # it ended while it was looked at
        return 0.0
    return total / 1e6
