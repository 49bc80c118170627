"""RL3, seeds: they change something, later episodes follow from them, and no generator of the process is moved."""

import random
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.attributes import read_generators
from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.families.determinism import compare
from rlctl.checking.instance import Context, Instance
from rlctl.checking.leaves import flatten_numbers
from rlctl.checking.records import FIRST_SEED, ChildMessage, Records
from rlctl.checking.rules import NotJudged, RuleFinding, check, experiment

WATCHED_STEPS = 300  # For how many steps the process's random generators are compared
UNSEEDED_RESETS, UNSEEDED_STEPS = 2, 20  # Of two discrete starts one may be the same by chance
FEWEST_SEEDS = 4


@check("RL306", "comparisons", "episodes", of_absence=True)
def _compare_seeds(records: Records) -> Iterator[RuleFinding]:
    built = records.require_built()
    trajectory, difference = compare(records, "alone", "seeds")
    if difference is not None:
        return
    starts = [
        episode
        for episode in records.require_alone()
        if 0 in episode.observations and len(episode.observations[0].steps)
    ]
    seeds = len({start.seed for start in starts})
    if seeds < FEWEST_SEEDS:
        raise NotJudged(f"fewer than {FEWEST_SEEDS} seeds were tried")
    for index, _ in enumerate(built.leaves):
        values = [start.observations[index].values[0] for start in starts if index in start.observations]
        if any(not np.array_equal(values[0], other) for other in values[1:]):
            return
    message = f"{seeds} seeds give one start, and with the same actions one trajectory of {trajectory.steps} steps"
    yield RuleFinding("RL306", message, {"seeds": seeds, "value": 1, "expected": seeds})


@experiment("unseeded", "RL308", share=0.5)
def compare_unseeded(context: Context) -> Iterator[ChildMessage]:
    """Play in two new instances after the same resets: first all with a seed, then the last ones without."""
    with context.fresh() as first, context.fresh() as second:
        if not first.accepts_seed:
            raise NotJudged("reset takes no seed (RL202)")
        if _differing(*(_play(instance, seed=FIRST_SEED) for instance in (first, second))):
            raise NotJudged("equal seeds and actions give unequal episodes (RL3)")
        values = _differing(*(_play(instance) for instance in (first, second)))
        agree = read_generators(first.env) == read_generators(second.env)
        if values and agree and _differing(*(_play(instance, seed=FIRST_SEED) for instance in (first, second))):
            raise NotJudged("an episode depends already on the one before it (RL301 to RL303)")
    if values:
        message = f"reset with one seed, and then without: {values[0]:.6g} in an observation, in another instance "
        evidence = {"seed": FIRST_SEED, "value": values[1], "expected": values[0]}
        yield RuleFinding("RL308", f"{message}{values[1]:.6g}", evidence)


def _play(instance: Instance, **seed: int) -> NDArray[np.float64]:
    """Reset with a seed and then a few times as given; return the numbers of these and of some more observations."""
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=UNSEEDED_STEPS)
    episode.reset()
    starts = [instance.call("reset", instance.env.reset, **seed) for _ in range(UNSEEDED_RESETS)]
    observations = [start[0] if isinstance(start, tuple) else start for start in starts]
    while not episode.ended:
        observations.append(episode.step().observation)
    numbers = np.concatenate([flatten_numbers(observation) for observation in observations])
    return np.nan_to_num(numbers.astype(np.float64))


def _differing(one: NDArray[np.float64], two: NDArray[np.float64]) -> list[float]:
    rows = min(len(one), len(two))
    unequal = np.flatnonzero(one[:rows] != two[:rows])
    return [float(numbers[unequal[0]]) for numbers in (one, two)] if unequal.size else []


@experiment("global random", "RL309", share=0.5)
def compare_generators(context: Context) -> Iterator[ChildMessage]:
    """Play the beginning of an episode, and say which generators of the whole process it moves, and where first."""
    moved: set[str] = set()
    episode = EpisodePlayer(context.instance, FIRST_SEED, max_steps=WATCHED_STEPS)
    before = _read_generators()
    for moment in episode:
        after = _read_generators()
        for generator, state in after.items():
            if state != before.get(generator, state) and generator not in moved:
                moved.add(generator)
                call, at = ("step", f" at step {moment.step}") if moment.step else ("reset", "")
                evidence = {"generator": generator, "call": call, "step": moment.step}
                yield RuleFinding("RL309", f"{call} moves the global generator {generator}{at}", evidence)
        before = _read_generators()


def _read_generators() -> dict[str, Any]:
    kind, keys, position, *rest = np.random.get_state()  # noqa: NPY002 (this one is what is compared)
    states = {"numpy.random": (kind, np.asarray(keys).tobytes(), position, *rest), "random": random.getstate()}
    if "torch" in sys.modules:
        states["torch"] = sys.modules["torch"].random.get_rng_state().numpy().tobytes()
    return states
