"""The actions an environment is tried with: a function of the space, a kind and a seed."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gymnasium import spaces

HOLD_STEPS = 10
"""How long an extreme action is held."""
RARE = 0.1
"""How often a rare action is not zero."""


def actions(space: spaces.Space[Any], kind: str, seed: int) -> Iterator[Any]:
    """Yield actions without end: `random`, `zero`, `repeated` (a random one, always the same), `rare` (zero but now and
    then), or `extreme` (corners of the space, each held for a while)."""
    # A copy: the environment's own space has a generator that it may use, or share with other instances.
    space = copy.deepcopy(space)
    space.seed(seed)
    if kind == "random":
        while True:
            yield space.sample()
    if kind == "zero":
        while True:
            yield zero_action(space)
    if kind == "repeated":
        repeated = space.sample()
        while True:
            yield copy.deepcopy(repeated)
    rng = np.random.default_rng(seed)
    while kind == "rare":
        yield space.sample() if rng.random() < RARE else zero_action(space)
    while True:
        corner = _corner(space, rng)
        for _ in range(HOLD_STEPS):
            yield copy.deepcopy(corner)


def zero_action(space: spaces.Space[Any]) -> Any:
    """Return the action that is nearest to doing nothing: zeros, or what stands first."""
    from gymnasium import spaces

    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    if isinstance(space, spaces.Discrete):
        return space.start
    if isinstance(space, spaces.MultiDiscrete):
        return np.zeros(space.shape, space.dtype) + getattr(space, "start", np.zeros_like(space.nvec))
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, space.dtype)
    if isinstance(space, spaces.Dict):
        return {key: zero_action(value) for key, value in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(zero_action(value) for value in space.spaces)
    return space.sample()


def _corner(space: spaces.Space[Any], rng: np.random.Generator) -> Any:
    from gymnasium import spaces

    if isinstance(space, spaces.Box):
        corner = np.where(rng.random(space.shape) < 0.5, space.low, space.high)
        return np.where(np.isfinite(corner), corner, space.sample()).astype(space.dtype)
    if isinstance(space, spaces.Discrete):
        return space.start + (space.n - 1) * int(rng.integers(2))
    if isinstance(space, spaces.MultiDiscrete):
        last = (space.nvec - 1) * rng.integers(2, size=space.shape)
        return (zero_action(space) + last).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(2, size=space.shape).astype(space.dtype)
    if isinstance(space, spaces.Dict):
        return {key: _corner(value, rng) for key, value in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_corner(value, rng) for value in space.spaces)
    return space.sample()
