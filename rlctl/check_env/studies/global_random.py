"""Watches the random generators that belong to the whole process."""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.check_env.context import Context
from rlctl.check_env.evidence import FIRST_SEED
from rlctl.check_env.legacy import result
from rlctl.check_env.messages import Message
from rlctl.check_env.recording import Plan, Recording
from rlctl.check_env.results import GlobalRandom, GlobalUse

WATCHED_STEPS = 30


def global_random(context: Context) -> Iterator[Message]:
    """Live the begin of an episode, and say which global generators it moves, and in which call first."""
    uses: dict[str, GlobalUse] = {}
    recording = Recording(context.instance, Plan("global random", 0, FIRST_SEED), context.budget)
    before = _states()
    recording.reset()
    _compare(before, "reset", 0, uses)
    while recording.running and recording.steps < WATCHED_STEPS and context.budget.seconds_left > 0:
        before = _states()
        recording.step()
        _compare(before, "step", recording.steps, uses)
    if recording.failure is not None:
        yield recording.failure
    else:
        yield result(GlobalRandom(list(uses.values())))


def _compare(before: dict[str, Any], call: str, step: int, uses: dict[str, GlobalUse]) -> None:
    for generator, state in _states().items():
        if state != before.get(generator, state):
            uses.setdefault(generator, GlobalUse(generator, call, step))


def _states() -> dict[str, Any]:
    kind, keys, position, *rest = np.random.get_state()  # noqa: NPY002 (this one is what is watched)
    states = {"numpy.random": (kind, np.asarray(keys).tobytes(), position, *rest), "random": random.getstate()}
    if "torch" in sys.modules:
        states["torch"] = sys.modules["torch"].random.get_rng_state().numpy().tobytes()
    return states
