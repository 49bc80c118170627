"""Noise and delay between the world, the policy and the motors."""

from collections import deque

import numpy as np

from rlctl.task.events.event import Drawn, Parts, Signal, acts_at
from rlctl.task.events.ranges import NotNegative, Steps

Rng = np.random.Generator


@acts_at("observation", "action", std=0.0)
def noise(rng: Rng, first: Parts, *, std: NotNegative) -> tuple[Drawn, Signal]:
    """Add normal noise to every element at every step.

    Its standard deviation, in the unit of the observation or the action, is drawn once per episode.
    """
    drawn = float(rng.uniform(*std))

    def disturb(parts: Parts) -> Parts:
        return {name: value + drawn * rng.standard_normal(np.shape(value)) for name, value in parts.items()}

    return {"std": drawn}, disturb


@acts_at("observation", "action", steps=0.0)
def delay(rng: Rng, first: Parts, *, steps: Steps) -> tuple[Drawn, Signal]:
    """Delay all values by some control steps; the number is drawn once per episode, both ends included.

    Until then an observation is the episode's first, and an action is 0, or the action nearest to 0.
    """
    drawn = int(rng.integers(int(steps[0]), int(steps[1]) + 1))
    past = deque([_copy_parts(first)] * drawn, maxlen=drawn + 1)

    def late(parts: Parts) -> Parts:
        past.append(_copy_parts(parts))
        return past[0]

    return {"steps": float(drawn)}, late


def _copy_parts(parts: Parts) -> Parts:
    # A task may change its arrays later.
    return {name: np.array(value) for name, value in parts.items()}
