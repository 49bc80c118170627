"""RL405: leaks on reset."""

import ctypes
import dataclasses
import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, EnvironmentRaised, describe_failure
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.environments.bullet_clients import find_clients

RULE = Rule(
    "RL405",
    "leaks on reset",
    Severity.WARNING,
    meaning="""
        Every reset leaves something behind: a PyBullet client, bodies in the world, open files, threads,
        memory. A training resets some ten thousand times: it slows down, the world fills with old robots, or
        the process ends at a limit (PyBullet has 1024 clients).
    """,
    fix="""
        Connect, open and start things once, in the constructor. In reset use resetSimulation or restoreState,
        and close whatever reset opens again.
    """,
)

MOST_RESETS = 100
MEASURED_RESETS = 10  # between measurements of memory; the first ones fill caches
FEWEST_RESETS, FEWEST_MEASUREMENTS = 8, 3  # With fewer, growth cannot be distinguished from a slow start
SETTLING_RESETS = 2  # The first resets load what later ones keep
LEAST_GROWTH = 3  # In each half of the resets, so that one late object is not a leak
MEMORY_GROWTH = 8 * 2**20  # after the warm-up [bytes]; allocators move by 1 to 2 MiB
LATER_SHARE = 0.4  # of the growth in the second half: a leak does not slow down
LEAKS = {
    "PyBullet clients": Severity.ERROR,
    "bodies in the PyBullet world": Severity.ERROR,
    "open file descriptors": Severity.WARNING,
    "threads": Severity.WARNING,
}
_PROCESS = Path("/proc/self")


@dataclasses.dataclass
class Counts:
    """What an instance holds after each of many resets."""

    resets: int = 0
    series: dict[str, list[int]] = dataclasses.field(default_factory=dict)  # by key of LEAKS, a count per reset
    memory: list[int] = dataclasses.field(default_factory=list)  # resident [bytes], if it is known

    def count(self) -> None:
        """Count what is there now."""
        clients, pybullet = find_clients(), sys.modules.get("pybullet")
        bodies = [pybullet.getNumBodies(physicsClientId=client) for client in clients] if pybullet else []
        numbers = [len(clients), sum(bodies)]
        if _PROCESS.exists():
            numbers += [len(os.listdir(_PROCESS / "fd")), len(os.listdir(_PROCESS / "task"))]
        for what, number in zip(LEAKS, numbers, strict=False):
            self.series.setdefault(what, []).append(number)
        self.resets += 1

    def measure_memory(self) -> None:
        """Note the resident memory, without what only waits to be collected."""
        if not _PROCESS.exists():
            return
        gc.collect()
        # Python would otherwise reuse freed memory, and a leak would not show.
        if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
            trim(0)
        self.memory.append(int((_PROCESS / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))


@experiment("leaks", PROBE, 100, RULE, share=3.0)
def count_after_resets(context: Context) -> Iterator[ChildMessage]:
    """Reset the process's instance many times, with one step each, and count what it holds."""
    counts = Counts()
    instance, budget = context.instance, context.budget
    gc.freeze()  # what there is already need not be looked through again and again
    try:
        while counts.resets < MOST_RESETS and not budget.is_over():
            for _ in EpisodePlayer(instance, FIRST_SEED + counts.resets, number=counts.resets, max_steps=1):
                pass
            counts.count()
            if counts.resets % MEASURED_RESETS == 0:
                counts.measure_memory()
    except EnvironmentRaised as error:
        if counts.resets < FEWEST_RESETS:
            raise
        yield describe_failure(error, context.progress)
    finally:
        gc.unfreeze()
    yield from find_growth(counts)


def find_growth(counts: Counts) -> Iterator[RuleFinding]:
    """Yield what grows with every reset; raises `NotJudged` where there were too few of them."""
    resets = counts.resets
    if resets < FEWEST_RESETS:
        raise NotJudged(f"time ran out after {resets} resets")
    for what, series in counts.series.items():
        if growth := _growth(series):
            first, after = series[SETTLING_RESETS], resets - SETTLING_RESETS - 1
            message = f"{what} grow with every reset: from {first} to {series[-1]} in {after} resets"
            evidence = {"element": what, "value": series[-1], "expected": first, "resets": after}
            yield RuleFinding(RULE, message, {**evidence, "per_reset": growth / after}, LEAKS[what])
            return  # a client brings its own bodies, files, threads and memory
    if len(counts.memory) >= FEWEST_MEASUREMENTS:
        start, middle, end = (counts.memory[i] for i in (0, (len(counts.memory) - 1) // 2, -1))
        resets = MEASURED_RESETS * (len(counts.memory) - 1)
        if end - start > MEMORY_GROWTH and end - middle > LATER_SHARE * (end - start):
            grown, late = (f"{(end - before) / 2**20:.1f} MiB" for before in (start, middle))
            message = f"memory grows with every reset: by {grown} in {resets} resets, by {late} in the second half"
            evidence = {"element": "memory", "value": end, "expected": start, "resets": resets}
            yield RuleFinding(RULE, message, {**evidence, "per_reset": (end - start) / resets})


def _growth(series: list[int]) -> int:
    series = series[SETTLING_RESETS:]
    first, second = series[: len(series) // 2], series[len(series) // 2 :]
    grows = all(half[-1] - half[0] >= LEAST_GROWTH for half in (first, second)) and min(second) >= max(first)
    return series[-1] - series[0] if grows else 0
