"""RL312: resets without a seed repeat."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.episode import EpisodePlayer
from rlctl.checking.experiment import PROBE, experiment
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged, Rule, RuleFinding, Severity
from rlctl.checking.values import flatten

RULE = Rule(
    "RL312",
    "resets without a seed repeat",
    Severity.WARNING,
    meaning="""
        Resets with different seeds begin different episodes, and every reset without a seed begins the same one
        again: it seeds the generator with a constant, or with the last seed. rlctl seeds every episode; most
        other training scripts seed only the first, and then learn one episode by heart.
    """,
    fix="""
        Seed the generator only if reset gets a seed: super().reset(seed=seed) does so with None too. Draw from
        self.np_random, which goes on without a seed.
    """,
)

RESETS, STEPS = 6, 5  # of each kind, and how far they are compared
LEAST_DIFFERENT = 5  # of the episodes with a seed: among fewer, equal ones may be chance


@experiment("unseeded resets", PROBE, 85, RULE, share=0.1)
def repeat_unseeded(context: Context) -> Iterator[ChildMessage]:
    """Begin episodes with other seeds, and then without one; the actions are always the same."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    seeded = {*_play(instance, [{"seed": FIRST_SEED + number} for number in range(RESETS)])}
    if len(seeded) < LEAST_DIFFERENT:
        raise NotApplicable(f"{RESETS} seeds begin {len(seeded)} different episodes")
    if len({*_play(instance, [{}] * RESETS)}) == 1:
        message = f"{RESETS} resets without a seed begin one episode, {RESETS} with other seeds {len(seeded)}"
        yield RuleFinding(RULE, message, {"call": "reset", "value": 1, "expected": RESETS, "steps": STEPS})


def _play(instance: Instance, arguments: Sequence[Mapping[str, int]]) -> Iterator[bytes]:
    """Reset with a seed, and then with each of these arguments; yield what the first observations after each hold."""
    player = EpisodePlayer(instance, FIRST_SEED, "repeated")
    player.reset()
    for keywords in arguments:
        returned = instance.call("reset", instance.env.reset, **keywords)
        observed = [flatten(returned[0] if isinstance(returned, tuple) else returned)]
        for _ in range(STEPS):
            moment = player.step()
            observed.append(flatten(moment.observation))
            if any(moment.flags):
                break
        yield np.concatenate(observed).tobytes()
