"""Spaces taken apart into arrays (leaves), with the bounds and the name of each."""

import dataclasses
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Path = tuple[str | int, ...]
KNOWN = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One array of a space. Every supported kind has bounds: Discrete(n) is the integers from 0 to n - 1."""

    path: Path  # Keys and places from the whole value to this array
    kind: str  # `Box`, `Discrete`, `MultiDiscrete`, `MultiBinary`, or another class, as `gym.Box` of the old gym
    shape: tuple[int, ...] = ()
    dtype: str = ""
    low: NDArray[Any] | None = None  # Shape `shape`; None for a kind that cannot be judged
    high: NDArray[Any] | None = None

    @property
    def supported(self) -> bool:
        """Whether rules can look into it."""
        return self.low is not None

    @property
    def flat_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest value of each number. Shape (elements,)."""
        return np.ravel(np.asarray(self.low, np.float64)), np.ravel(np.asarray(self.high, np.float64))


def name_leaf(leaf: Leaf, of: str = "observation") -> str:
    """Return how to write the leaf of an observation or an action: `observation['camera'][0]`."""
    return of + "".join(f"[{key!r}]" for key in leaf.path)


def name_element(leaf: Leaf, index: int, of: str = "observation") -> str:
    """Return how to write one number of a leaf, given by its flat index: `observation['camera'][3, 0, 2]`."""
    where = name_leaf(leaf, of)
    if not leaf.shape:
        return where
    return f"{where}[{', '.join(str(int(i)) for i in np.unravel_index(index, leaf.shape))}]"


def find_leaves(space: Any, path: Path = ()) -> list[Leaf]:
    """Take a space apart; what is not a known space becomes a leaf that is not supported."""
    if isinstance(space, spaces.Dict):
        return [leaf for key, value in space.spaces.items() for leaf in find_leaves(value, (*path, key))]
    if isinstance(space, spaces.Tuple):
        return [leaf for i, value in enumerate(space.spaces) for leaf in find_leaves(value, (*path, i))]
    kind = _name_kind(space)
    if (bounds := _bounds(space)) is None:
        return [Leaf(path, kind)]
    return [Leaf(path, kind, tuple(space.shape), str(space.dtype), *bounds)]


def _name_kind(space: Any) -> str:
    for known in KNOWN:
        if isinstance(space, known):  # also a class of the environment's own
            return known.__name__
    kind = type(space)
    if isinstance(space, spaces.Space) or not hasattr(spaces, kind.__name__):
        return kind.__name__
    return f"{kind.__module__.partition('.')[0]}.{kind.__name__}"


def _bounds(space: spaces.Space[Any]) -> tuple[NDArray[Any], NDArray[Any]] | None:
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
