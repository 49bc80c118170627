"""RL309: global random generator."""

import random
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import Rule, RuleFinding, Severity

RULE = Rule(
    "RL309",
    "global random generator",
    Severity.WARNING,
    meaning="""
        reset or step draws from, or seeds, a generator of the whole process (`numpy.random`, `random`,
        `torch`). Environments in one process then change each other's episodes, and the random numbers of the
        training.
    """,
    fix="Draw from self.np_random. If a library needs a generator, pass this one, or a seed drawn from it.",
    task_fix="""
        Draw only from `rng`, the argument of reset; use no np.random.*, random.*, default_rng() or time.
    """,
    shows_one=True,
)

WATCHED_STEPS = 300  # For how many steps the process's random generators are compared


@experiment("global random", PROBE, 30, RULE, share=0.5)
def compare_generators(context: Context) -> Iterator[ChildMessage]:
    """Play the beginning of an episode, and say which generators of the whole process it moves, and where first."""
    moved: set[str] = set()
    episode = EpisodePlayer(context.instance, FIRST_SEED, max_steps=WATCHED_STEPS)
    before = _read_generators()
    for moment in episode:
        for generator, state in _read_generators().items():
            if state != before.get(generator, state) and generator not in moved:
                moved.add(generator)
                call, at = ("step", f" at step {moment.step}") if moment.step else ("reset", "")
                evidence = {"generator": generator, "call": call, "step": moment.step}
                yield RuleFinding(RULE, f"{call} moves the global generator {generator}{at}", evidence)
        before = _read_generators()


def _read_generators() -> dict[str, Any]:
    kind, keys, position, *rest = np.random.get_state()  # noqa: NPY002 (this one is what is compared)
    states = {"numpy.random": (kind, np.asarray(keys).tobytes(), position, *rest), "random": random.getstate()}
    if "torch" in sys.modules:
        states["torch"] = sys.modules["torch"].random.get_rng_state().numpy().tobytes()
    return states
