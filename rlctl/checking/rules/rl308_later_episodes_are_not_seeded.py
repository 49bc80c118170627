"""RL308: later episodes are not seeded."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import INSTANCES, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.values import flatten, read_generators

RULE = Rule(
    "RL308",
    "later episodes are not seeded",
    Severity.WARNING,
    meaning="""
        A seeded reset repeats, but the next reset without a seed does not: it draws from another generator.
        rlctl seeds every episode; most other training scripts seed only the first, and cannot be repeated then.
    """,
    fix="""
        If reset gets no seed, continue with the generator of the last seed: call super().reset(seed=seed), draw
        from self.np_random, and give the same generator to the parts of the environment.
    """,
    task_fix="""
        Draw only from `rng`, the argument of reset; use no np.random.*, random.*, default_rng() or time.
    """,
    shows_one=True,
)

UNSEEDED_RESETS, UNSEEDED_STEPS = 2, 20  # Of two discrete starts one may be the same by chance


@experiment("unseeded", INSTANCES, 50, RULE, share=0.5)
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
            raise NotJudged("an episode already depends on the previous one (RL301 to RL303)")
    if values:
        numbers = f"an observation contains {values[0]:.6g}, in another instance {values[1]:.6g}"
        evidence = {"seed": FIRST_SEED, "value": values[1], "expected": values[0]}
        yield RuleFinding(RULE, f"reset first with a seed, then without: {numbers}", evidence)


def _play(instance: Instance, **seed: int) -> NDArray[np.float64]:
    episode = EpisodePlayer(instance, FIRST_SEED, max_steps=UNSEEDED_STEPS)
    episode.reset()
    starts = [instance.call("reset", instance.env.reset, **seed) for _ in range(UNSEEDED_RESETS)]
    observations = [start[0] if isinstance(start, tuple) else start for start in starts]
    while not episode.ended:
        observations.append(episode.step().observation)
    numbers = np.concatenate([flatten(observation) for observation in observations])
    return np.nan_to_num(numbers.astype(np.float64))


def _differing(one: NDArray[np.float64], two: NDArray[np.float64]) -> list[float]:
    rows = min(len(one), len(two))
    unequal = np.flatnonzero(one[:rows] != two[:rows])
    return [float(numbers[unequal[0]]) for numbers in (one, two)] if unequal.size else []
