"""RL4, resources: what an instance takes it gives back, and it can be built where training builds it."""

from __future__ import annotations

from collections.abc import Iterator

from rlctl.check_env.evidence import Evidence
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import Leaks, WorkerBuild
from rlctl.check_env.rules.known import built, result

ERROR, WARNING = Severity.ERROR, Severity.WARNING

FEWEST_RESETS = 8
"""With fewer, growth is not told from a slow start."""
SETTLING_RESETS = 2
"""The first resets load what later ones keep."""
LEAST_GROWTH = 3
"""In each half of the resets, so that one late object is no leak."""
FEWEST_RESETS_FOR_MEMORY = 30
MEMORY_GROWTH = 8 * 2**20
"""Over the resets after the warm-up [bytes]. Allocators of clean environments move by 1 to 2 MiB; 0.1 MB per reset
fills the memory of 16 workers in a day."""
LATER_SHARE = 0.4
"""Of the growth, so much must be in the second half: what fills once slows down, a leak does not."""


def _growth(counts: list[int]) -> int:
    """Return by how much a count grows, if it does so all the time; else 0."""
    counts = counts[SETTLING_RESETS:]
    middle = len(counts) // 2
    first, second = counts[:middle], counts[middle:]
    steady = (
        min(second) >= max(first) and second[-1] - second[0] >= LEAST_GROWTH and first[-1] - first[0] >= LEAST_GROWTH
    )
    return counts[-1] - counts[0] if steady else 0


@rule(
    "RL405",
    "leaks on reset",
    WARNING,
    "Connect, open and start in the constructor, once; reset only resets (resetSimulation or restoreState), and "
    "whatever it opens anew it closes first.",
    needs=("leaks",),
)
def leaks(evidence: Evidence) -> Iterator[Seen]:
    """Every reset leaves something behind: a PyBullet client, bodies in the world, open files, threads, memory. A
    training resets some ten thousand times: it slows down, the world fills with old robots, or the process ends at a
    limit (PyBullet has 1024 clients)."""
    known = result(evidence, Leaks, "leaks")
    resets = len(known.clients)
    if resets < FEWEST_RESETS:
        raise NotJudged(f"there was time for only {resets} resets")
    kinds = (
        ("PyBullet clients", known.clients, ERROR),
        ("bodies in the PyBullet world", known.bodies, ERROR),
        ("open file descriptors", known.descriptors, WARNING),
        ("threads", known.threads, WARNING),
    )
    found = [
        _seen(what, counts, growth, severity)
        for what, counts, severity in kinds
        if len(counts) == resets and (growth := _growth(counts))
    ]
    # A client brings its own bodies, files, threads and memory.
    yield from found[:1]
    if not found:
        yield from _memory(known)


def _seen(what: str, counts: list[int], growth: int, severity: Severity) -> Seen:
    first, resets = counts[SETTLING_RESETS], len(counts) - SETTLING_RESETS
    return Seen(
        f"{what} grow with every reset: from {first} to {counts[-1]} in {resets - 1} resets",
        {
            "element": what,
            "value": counts[-1],
            "expected": first,
            "resets": resets - 1,
            "per_reset": growth / (resets - 1),
        },
        severity,
    )


def _memory(known: Leaks) -> Iterator[Seen]:
    if len(known.memory) != 3 or known.measured[-1] < FEWEST_RESETS_FOR_MEMORY:
        return
    start, middle, end = known.memory
    resets = known.measured[-1] - known.measured[0]
    growth, later = end - start, end - middle
    if growth > MEMORY_GROWTH and later > LATER_SHARE * growth:
        yield Seen(
            f"memory grows with every reset: by {growth / 2**20:.1f} MiB in {resets} resets, of which "
            f"{later / 2**20:.1f} MiB in the second half",
            {"element": "memory", "value": end, "expected": start, "resets": resets, "per_reset": growth / resets},
        )


@rule(
    "RL406",
    "not buildable in a worker",
    ERROR,
    "Start no process in the constructor, read no state of the main script, and open nothing at import; or train with "
    "DummyVecEnv.",
    needs=("worker build",),
)
def worker_build(evidence: Evidence) -> Iterator[Seen]:
    """It cannot be built, reset or stepped in a daemonic process that `multiprocessing` spawned. That is where
    Stable-Baselines3's SubprocVecEnv and other trainings with several processes build it; such a process has a fresh
    interpreter, and may have no children."""
    built(evidence)
    found = result(evidence, WorkerBuild, "worker build")
    if found.kind == "done":
        return
    if found.kind == "unknown":
        raise NotJudged(found.error)
    if any(each.call in ("load", "build") for each in evidence.failures):
        raise NotJudged("a second instance cannot be built at all (RL403)")
    if any(each.call == found.call for each in evidence.failures):
        raise NotJudged(f"{found.call} fails outside of a worker, too")
    verb = "raises " if found.kind == "raised" else ""
    details = {"traceback": found.details} if found.details else {}
    in_call = "the import" if found.call in ("import", "load") else found.call
    yield Seen(f"in a spawned, daemonic worker {in_call} {verb}{found.error}", {"call": found.call, **details})
