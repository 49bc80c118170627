"""The actions of an episode: a function of the action space, a kind and a seed."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env.leaves import Leaf, Path, find_leaves

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
    rng = np.random.default_rng(seed)
    while kind == "rare":
        yield space.sample() if rng.random() < RARE else zero_action(space)
    repeated = space.sample() if kind == "repeated" else None
    while True:
        if kind == "random":
            yield space.sample()
        elif kind == "zero":
            yield zero_action(space)
        elif kind == "repeated":
            yield copy.deepcopy(repeated)
        else:
            corner = build_action(space, lambda leaf: _corner(leaf, rng))
            for _ in range(HOLD_STEPS):
                yield copy.deepcopy(corner)


def build_action(space: spaces.Space[Any], value_of: Callable[[Leaf], Any], path: Path = ()) -> Any:
    """Return an action with what a function gives for each leaf of the space; a sample where that is None."""
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        return {key: build_action(each, value_of, (*path, key)) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(build_action(each, value_of, (*path, i)) for i, each in enumerate(space.spaces))
    (leaf,) = find_leaves(space, path)
    value = value_of(leaf)
    if value is None:
        return space.sample()
    if not leaf.supported:
        return value
    return int(value) if leaf.kind == "Discrete" else np.asarray(value).astype(leaf.dtype)


def zero_action(space: spaces.Space[Any]) -> Any:
    """Return the action that is nearest to doing nothing: zeros, or what is nearest to them."""
    return build_action(space, lambda leaf: np.clip(0, leaf.low, leaf.high) if leaf.supported else None)


def action_at(space: spaces.Space[Any], numbers: NDArray[np.float64]) -> Any:
    """Return the action at a point of the unit cube, of one number for each of the flat action.

    The numbers are spread over the bounds; where there are none, over [-1, 1].
    """
    rest = iter(numbers)

    def value_of(leaf: Leaf) -> NDArray[Any]:
        point = np.array([next(rest) for _ in range(int(np.prod(leaf.shape)))]).reshape(leaf.shape)
        low, high = np.asarray(leaf.low, np.float64), np.asarray(leaf.high, np.float64)
        if np.dtype(leaf.dtype).kind in "iub":
            return np.minimum(np.floor(low + point * (high - low + 1)), high)
        low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
        return low + point * (high - low)

    return build_action(space, value_of)


def _corner(leaf: Leaf, rng: np.random.Generator) -> NDArray[Any] | None:
    if leaf.low is None or leaf.high is None:
        return None
    corner = np.where(rng.random(leaf.shape) < 0.5, leaf.low, leaf.high)
    return np.where(np.isfinite(corner), corner, np.clip(rng.standard_normal(leaf.shape), leaf.low, leaf.high))
