"""Spaces taken apart into leaves: arrays with a shape, a type and bounds."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gymnasium import spaces

Path = tuple[str | int, ...]


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One array of a space. Every supported kind has bounds: Discrete(n) is the integers from 0 to n - 1."""

    path: Path
    """Keys and places from the whole value to this array."""
    kind: str
    """`Box`, `Discrete`, `MultiDiscrete`, `MultiBinary`, or the name of a class that cannot be judged."""
    shape: tuple[int, ...] = ()
    dtype: str = ""
    low: NDArray[Any] | None = None
    """Shape `shape`; None for a kind that cannot be judged."""
    high: NDArray[Any] | None = None

    @property
    def supported(self) -> bool:
        return self.low is not None


def leaf_name(leaf: Leaf) -> str:
    """Return how to write the leaf of an observation: `observation['camera'][0]`."""
    return "observation" + "".join(f"[{key!r}]" for key in leaf.path)


def leaves_of(space: Any, path: Path = ()) -> list[Leaf]:
    """Take a space apart; what is not a known space becomes a leaf that is not supported."""
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        return [leaf for key, value in space.spaces.items() for leaf in leaves_of(value, (*path, key))]
    if isinstance(space, spaces.Tuple):
        return [leaf for i, value in enumerate(space.spaces) for leaf in leaves_of(value, (*path, i))]
    bounds = _bounds(space)
    kind = type(space).__name__
    if bounds is None:
        return [Leaf(path, kind)]
    low, high = bounds
    return [Leaf(path, kind, tuple(space.shape), str(space.dtype), low, high)]


def _bounds(space: spaces.Space[Any]) -> tuple[NDArray[Any], NDArray[Any]] | None:
    from gymnasium import spaces

    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.Discrete):
        return np.array(space.start), np.array(space.start + space.n - 1)
    if isinstance(space, spaces.MultiDiscrete):
        start = np.asarray(getattr(space, "start", np.zeros_like(space.nvec)))
        return start, start + space.nvec - 1
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, np.int8), np.ones(space.shape, np.int8)
    return None


def pick(value: Any, path: Path) -> Any:
    """Return the part of an observation that a leaf stands for; raises `LookupError` or `TypeError`."""
    for key in path:
        value = value[key]
    return value
