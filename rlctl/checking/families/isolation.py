"""RL4: instances do not influence each other, and release what they acquire."""

import contextlib
import ctypes
import dataclasses
import gc
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, PROBE, experiment, judges_records
from rlctl.checking.families.determinism import COMPARED_STEPS, compare, report, require_independent
from rlctl.checking.families.interface import select_failures
from rlctl.checking.instance import Context, EnvironmentRaised, Instance, describe_failure
from rlctl.checking.recording import Recording
from rlctl.checking.records import FIRST_SEED, SECOND_SEED, ChildMessage, Records, Skipped
from rlctl.checking.rule import UNMOVED, NotJudged, RuleFinding, Severity, list_names
from rlctl.environments import registry
from rlctl.environments.bullet_calls import BulletCall, record_calls
from rlctl.environments.bullet_clients import find_clients

IN_TURNS, AFTER_CLOSE = "two instances stepped alternately", "after another instance was closed"
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


@experiment("instances", INSTANCES, 10, "RL404", "RL808", share=10.0)
def compare_instances(context: Context) -> Iterator[ChildMessage]:
    """Play on three instances: one alone, one after it, and two side by side of which one is closed."""
    progress, budget = context.progress, context.budget
    longest_s = budget.seconds_left / 5

    def begin(instance: Instance, role: str, seed: int) -> Recording:
        progress.phase(role)
        number, steps = seed - FIRST_SEED, COMPARED_STEPS
        return Recording(role, EpisodePlayer(instance, seed, number=number, max_steps=steps, longest_s=longest_s))

    progress.phase("alone")
    with contextlib.suppress(BaseException):  # `build` reports what it raises
        registry.load(context.spec.task)  # and so, usually, PyBullet
    with record_calls(with_results=()) as calls:
        first = context.build()
    with record_calls(with_results=()) as later:  # of a PyBullet that the constructor has imported
        yield from begin(first, "fresh process", FIRST_SEED).run()
        yield from begin(first, "second alone", SECOND_SEED).run()
    yield from first.close()
    yield from _left_out_clients(sorted(calls.without_client | later.without_client))

    progress.phase("fresh instance")
    neighbour = context.build()
    yield from begin(neighbour, "fresh instance", FIRST_SEED).run()
    if budget.is_over():
        yield from neighbour.close()
        return

    # From here on each instance has played the same episodes, in the same order, as `first` had.
    progress.phase("interleaved")
    survivor = context.build()
    if isinstance(survivor.env, gymnasium.Env):
        yield from _shared_spaces(survivor.env, neighbour.env)
    else:
        yield Skipped("RL404", "it is not a gymnasium.Env (RL003)")
    pair = begin(survivor, "interleaved", FIRST_SEED), begin(neighbour, "interleaved second", SECOND_SEED)
    progress.phase("interleaved")
    while running := [recording for recording in pair if recording.running]:
        for recording in running:
            recording.advance()
    for recording in pair:
        yield from recording.run()
    recording = begin(survivor, "after close", SECOND_SEED)
    for _ in range(2):
        if recording.running:
            recording.advance()
    progress.phase("close")
    yield from neighbour.close()
    progress.phase("after close")
    yield from recording.run()
    yield from survivor.close()


def _left_out_clients(calls: Sequence[BulletCall]) -> Iterator[ChildMessage]:
    if "pybullet" not in sys.modules:
        yield Skipped("RL808", "no PyBullet world", applies=False)
    if calls:
        count = f"{len(calls)} calls" if len(calls) > 1 else "a call"
        shown = list_names([f"{call.place} {call.name}" for call in calls], most=3)
        evidence = {"file": calls[0].file, "line": calls[0].line, "places": [call.place for call in calls[:20]]}
        yield RuleFinding("RL808", f"{count} of PyBullet without physicsClientId: {shown}", evidence)


def _require_same_alone(records: Records) -> None:
    if compare(records, "fresh process", "fresh instance") is not None:
        raise NotJudged("two instances already differ when each is used alone (RL301 to RL304)")
    require_independent(records)


def _failure(records: Records, rule: str, phase: str, doing: str) -> RuleFinding | None:
    alone = {(failure.call, failure.error) for failure in select_failures(records, "raised")}
    for failure in records.failures:
        is_here = failure.process == "instances" and failure.phase == phase and failure.call != "build"
        if is_here and (failure.call, failure.error) not in alone:
            return RuleFinding(rule, f"{doing}, {failure.message}", failure.place)
    return None


@judges_records("RL401", "comparisons", "global random", "instances")
def _find_shared_world(records: Records) -> Iterator[RuleFinding]:
    _require_same_alone(records)
    if finding := _failure(records, "RL401", "interleaved", IN_TURNS):
        yield finding
        return
    for alone, beside in (("fresh process", "interleaved"), ("second alone", "interleaved second")):
        if (difference := compare(records, alone, beside)) is not None:
            draws = any(finding.rule == "RL309" for finding in records.findings)
            because = ("; both draw from a global random generator (RL309)", UNMOVED["RL309"].fix) if draws else ()
            yield report("RL401", records, difference, f"{IN_TURNS}, compared with one alone", *because)
            return


@judges_records("RL402", "comparisons", "instances")
def _find_effect_of_closing(records: Records) -> Iterator[RuleFinding]:
    _require_same_alone(records)
    if finding := _failure(records, "RL402", "after close", AFTER_CLOSE):
        yield finding
        return
    if list(_find_shared_world.run(records)):
        raise NotJudged("the instances already affect each other before one is closed (RL401)")
    if (difference := compare(records, "second alone", "after close")) is not None:
        yield report("RL402", records, difference, f"{AFTER_CLOSE}, compared with one alone")


@judges_records("RL403", "instances")
def _find_single_instance(records: Records) -> Iterator[RuleFinding]:
    for failure in records.failures:
        if failure.call in ("load", "build") and failure.process != "probe":
            where = "in one process" if failure.phase in ("fresh instance", "interleaved") else "in a second process"
            yield RuleFinding("RL403", f"a second instance {where} cannot be built: {failure.error}", failure.place)
            return


def _shared_spaces(one: Any, other: Any) -> Iterator[RuleFinding]:
    severities = {"action_space": Severity.WARNING, "observation_space": Severity.INFO}  # nobody samples observations
    shared = []
    for name, severity in severities.items():
        first, again, others = (getattr(env, name, None) for env in (one, one, other))
        if first is not again:
            message = f"{name} is a new object each time it is read, so that seeding it has no effect"
            yield RuleFinding("RL404", message, {"value": [name], "expected": []}, severity)
        elif first is others is not None:
            shared.append(name)
    if shared:
        message = f"two instances have one object as {' and '.join(shared)}"
        yield RuleFinding("RL404", message, {"value": shared, "expected": []}, severities[shared[0]])


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


@experiment("leaks", PROBE, 100, "RL405", share=3.0)
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
            yield RuleFinding("RL405", message, {**evidence, "per_reset": growth / after}, LEAKS[what])
            return  # a client brings its own bodies, files, threads and memory
    if len(counts.memory) >= FEWEST_MEASUREMENTS:
        start, middle, end = (counts.memory[i] for i in (0, (len(counts.memory) - 1) // 2, -1))
        resets = MEASURED_RESETS * (len(counts.memory) - 1)
        if end - start > MEMORY_GROWTH and end - middle > LATER_SHARE * (end - start):
            grown, late = (f"{(end - before) / 2**20:.1f} MiB" for before in (start, middle))
            message = f"memory grows with every reset: by {grown} in {resets} resets, by {late} in the second half"
            evidence = {"element": "memory", "value": end, "expected": start, "resets": resets}
            yield RuleFinding("RL405", message, {**evidence, "per_reset": (end - start) / resets})


def _growth(series: list[int]) -> int:
    series = series[SETTLING_RESETS:]
    first, second = series[: len(series) // 2], series[len(series) // 2 :]
    grows = all(half[-1] - half[0] >= LEAST_GROWTH for half in (first, second)) and min(second) >= max(first)
    return series[-1] - series[0] if grows else 0
