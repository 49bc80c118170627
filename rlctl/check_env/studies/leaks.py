"""Counts what an instance still holds after each of many resets: what it does not give back grows with them."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from rlctl.check_env.actions import actions
from rlctl.check_env.bullet_clients import connected
from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.failures import EnvironmentRaised
from rlctl.check_env.instance import Budget, Instance
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.results import Leaks

MOST_RESETS = 100
WARM_UP = 10
"""Resets after which caches and allocators are filled; memory is measured from there on."""
TRIAL_RESETS = 3
"""So many are timed to see how many there is time for."""
MARGIN = 0.7
"""The part of the time that is planned with."""

_PROCESS = Path("/proc/self")


def leaks(context: Context) -> Iterator[Message]:
    """Reset the process's instance many times, with one step each, and count what it holds."""
    counts = Leaks([], [], [], [], [], [])
    raised = None
    instance = context.instance
    gc.freeze()  # what there is already need not be looked through again and again
    try:
        _fill(counts, instance, context.budget)
    except EnvironmentRaised as error:
        raised = error
    finally:
        gc.unfreeze()
    yield result(counts)
    if raised is not None:
        raise raised


def _fill(counts: Leaks, instance: Instance, budget: Budget) -> None:
    begun = budget.seconds_left
    planned = MOST_RESETS
    done = 0
    while done < planned and budget.seconds_left > 0:
        _reset(instance, FIRST_SEED + done)
        done += 1
        _count(counts)
        if done == TRIAL_RESETS:
            # A margin, since a leak makes resets slower.
            affordable = done * MARGIN * begun / max(1e-9, begun - budget.seconds_left)
            planned = max(done, min(MOST_RESETS, int(affordable)))
        if done in (WARM_UP, (WARM_UP + planned) // 2, planned):
            _measure(counts, done)


def _reset(instance: Instance, seed: int) -> None:
    instance.progress.episode(seed - FIRST_SEED, seed)
    keywords = {"seed": seed} if instance.accepts_seed else {}
    instance.call("reset", instance.env.reset, **keywords)
    action = instance.call("sample", next, actions(instance.env.action_space, "random", seed))
    instance.call("step", instance.env.step, action, step=1)


def _count(counts: Leaks) -> None:
    clients = connected()
    counts.clients.append(len(clients))
    pybullet = sys.modules.get("pybullet")
    counts.bodies.append(sum(pybullet.getNumBodies(physicsClientId=each) for each in clients) if pybullet else 0)
    if _PROCESS.exists():
        counts.descriptors.append(len(os.listdir(_PROCESS / "fd")))
        counts.threads.append(len(os.listdir(_PROCESS / "task")))


def _measure(counts: Leaks, resets: int) -> None:
    """Note the resident memory; what only waits to be collected is no leak."""
    if not _PROCESS.exists():
        return
    gc.collect()
    # What was freed before would otherwise be used again, and hide what is kept.
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
    pages = int((_PROCESS / "statm").read_text().split()[1])
    counts.memory.append(pages * os.sysconf("SC_PAGE_SIZE"))
    counts.measured.append(resets)
