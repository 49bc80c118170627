"""RL3: equal seeds and equal actions give equal episodes.

Without it no result can be repeated, no failed episode lived again, and no run resumed exactly. The rules go from the
simplest cause to the farthest; where a nearer one explains a difference, the farther ones are not judged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from rlctl.check_env.comparison import Difference, first_difference
from rlctl.check_env.evidence import Evidence, Trajectory
from rlctl.check_env.finding import NotJudged, Severity
from rlctl.check_env.legacy import Seen, rule
from rlctl.check_env.results import GlobalRandom
from rlctl.check_env.rules.known import built, lived, one, result

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO

RNG_FIX = (
    "Call super().reset(seed=seed) and draw all chance from self.np_random; no np.random.*, random.* or time in "
    "the environment."
)
FEWEST_SEEDS = 4
OTHER_START = r"reset\(seed=123\)` (is non-deterministic|observations are not equal)"
OTHER_STEP = r"step (observations|rewards|termination) are not|np_random` is not properly"


def compared(evidence: Evidence, first: str, second: str) -> tuple[Trajectory, Difference | None]:
    """Compare two lives of an episode; raises `NotJudged` where they do not exist or could not be lived."""
    known = built(evidence)
    if not known.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    a, b = one(evidence, first), one(evidence, second)
    for each in (a, b):
        if each.ended == "raised":
            raise NotJudged("the episode raised (RL207)")
    if not any(series.values.size for series in a.observations.values()):
        raise NotJudged("no observation could be compared")
    return a, first_difference(known, a, b)


def _seen(evidence: Evidence, trajectory: Trajectory, difference: Difference, what: str) -> Seen:
    severity = WARNING if difference.is_small else None
    if built(evidence).nondeterministic:
        severity = INFO  # its registration says so
    return Seen(f"{what}: {difference.text()}", difference.evidence(trajectory), severity)


def _require_repeatable(evidence: Evidence) -> None:
    if compared(evidence, "alone", "reused")[1] is not None:
        raise NotJudged("the same instance already differs from itself (RL301, RL302)")


@rule(
    "RL301",
    "seed does not determine the start",
    ERROR,
    RNG_FIX,
    complaints=(OTHER_START, OTHER_STEP),
)
def start(evidence: Evidence) -> Iterator[Seen]:
    """Two resets of one instance with one seed give different first observations."""
    trajectory, difference = compared(evidence, "alone", "reused")
    if difference is not None and difference.step == 0:
        yield _seen(evidence, trajectory, difference, "reset twice with one seed")


@rule(
    "RL302",
    "trajectory not repeatable",
    ERROR,
    RNG_FIX + " Reset every attribute that step changes.",
    complaints=(OTHER_STEP, OTHER_START),
)
def trajectory(evidence: Evidence) -> Iterator[Seen]:
    """One instance, one seed, the same actions, and another trajectory: chance that the seed does not govern, or
    something that reset does not reset."""
    trajectory, difference = compared(evidence, "alone", "reused")
    if difference is not None and difference.step > 0:
        yield _seen(evidence, trajectory, difference, "lived twice by one instance")


@rule(
    "RL303",
    "an earlier episode leaks",
    ERROR,
    "Reset every attribute that step changes; in a simulation also velocities, contacts and motor targets (a full "
    "resetSimulation, or a state saved right after loading).",
    complaints=(OTHER_STEP, OTHER_START),
)
def after_another(evidence: Evidence) -> Iterator[Seen]:
    """After an unfinished episode with other actions the same seed gives another trajectory: reset leaves something
    of the episode before, so episodes are not independent."""
    _require_repeatable(evidence)
    trajectory, difference = compared(evidence, "alone", "dirty")
    if difference is not None:
        yield _seen(evidence, trajectory, difference, "lived again after an unfinished other episode")


@rule(
    "RL304",
    "a new instance differs",
    ERROR,
    "Keep state in self, not in the class or the module; close what the constructor opens; pass physicsClientId.",
)
def fresh_instance(evidence: Evidence) -> Iterator[Seen]:
    """A second instance in the same process lives the same seed and actions differently: instances share something
    (a class attribute, a module's global, a simulator that close leaves open)."""
    trajectory, difference = compared(evidence, "fresh process", "fresh instance")
    if difference is not None:
        _require_repeatable(evidence)
        yield _seen(evidence, trajectory, difference, "lived by a second instance in one process")


@rule(
    "RL305",
    "a new process differs",
    ERROR,
    "Look for set or hash order, os.environ, time, global generators seeded at import, and files that are read and "
    "written.",
)
def fresh_process(evidence: Evidence) -> Iterator[Seen]:
    """A new process with another PYTHONHASHSEED lives the same seed and actions differently. What was learned or
    measured today cannot be repeated tomorrow."""
    trajectory, difference = compared(evidence, "alone", "fresh process")
    if difference is not None:
        _require_repeatable(evidence)
        yield _seen(evidence, trajectory, difference, "lived by a new process")


@rule(
    "RL306",
    "seeds change nothing",
    WARNING,
    "If the task is meant to vary, draw the start from self.np_random in reset, after super().reset(seed=seed).",
)
def seeds_differ(evidence: Evidence) -> Iterator[Seen]:
    """All seeds give the same start and, with the same actions, the same trajectory. A fixed problem may be meant
    (a puzzle, a maze), and from outside it looks the same as a seed that is ignored: so this is never an error. It is
    a warning where observations are continuous, because a policy then learns one trajectory by heart, and only worth
    knowing where they are discrete. A fixed start with chance in the steps is no finding."""
    known = built(evidence)
    trajectory, difference = compared(evidence, "alone", "seeds")
    if difference is not None:
        return
    starts = [each for each in lived(evidence) if 0 in each.observations and len(each.observations[0].steps)]
    if len({each.seed for each in starts}) < FEWEST_SEEDS:
        raise NotJudged(f"fewer than {FEWEST_SEEDS} seeds were tried")
    for index, _ in enumerate(known.leaves):
        values = [each.observations[index].values[0] for each in starts if index in each.observations]
        if any(not np.array_equal(values[0], other) for other in values[1:]):
            return
    seeds = len({each.seed for each in starts})
    continuous = any(leaf.kind == "Box" for leaf in known.leaves)
    yield Seen(
        f"{seeds} seeds give one start, and with the same actions one trajectory of {trajectory.steps} steps",
        {"seeds": seeds, "value": 1, "expected": seeds},
        WARNING if continuous else INFO,
    )


@rule(
    "RL307",
    "info not repeatable",
    WARNING,
    "Leave times, counters and object ids out of info.",
    complaints=(r"step info are not",),
    only_complaints=True,
)
def same_info(evidence: Evidence) -> Iterator[Seen]:
    """The same step gives another info. Nothing learns from info, but what is logged from it cannot be compared."""
    return iter(())


@rule(
    "RL308",
    "later episodes are not seeded",
    WARNING,
    "Where reset gets no seed, go on with the generator that an earlier seed made: super().reset(seed=seed), then draw "
    "from self.np_random, and give parts of the environment that same generator.",
    complaints=(r"then `env\.reset\(\)`",),
)
def later_episodes(evidence: Evidence) -> Iterator[Seen]:
    """A seeded reset repeats, but a reset without a seed after it does not: it draws from somewhere else. rlctl seeds
    every episode; what seeds only the first, as most training scripts do, cannot be repeated."""
    trajectory, difference = compared(evidence, "unseeded", "unseeded again")
    if difference is not None:
        _require_repeatable(evidence)
        yield _seen(evidence, trajectory, difference, "reset with a seed and then without one, twice")


@rule(
    "RL309",
    "global random generator",
    WARNING,
    "Draw from self.np_random. Give a library that needs a generator this one, or a seed drawn from it.",
    needs=("global random",),
)
def global_random(evidence: Evidence) -> Iterator[Seen]:
    """reset or step draws from, or seeds, a generator that belongs to the whole process (`numpy.random`, `random`,
    `torch`). Environments in one process then change each other's episodes, and the learner's own random numbers."""
    for use in result(evidence, GlobalRandom, "global random").uses:
        at = f" at step {use.step}" if use.call == "step" else ""
        yield Seen(f"{use.call} moves the global generator {use.generator}{at}", dataclasses.asdict(use))
