"""Spaces taken apart into leaves (arrays with a shape, a type and bounds), and what came back, as plain data."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gymnasium import spaces

Path = tuple[str | int, ...]
NUMBERS = (bool, int, float, np.bool_, np.integer, np.floating)


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One array of a space. Every supported kind has bounds: Discrete(n) is the integers from 0 to n - 1."""

    path: Path  # Keys and places from the whole value to this array
    kind: str  # `Box`, `Discrete`, `MultiDiscrete`, `MultiBinary`, or another class
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
        low, high = (np.ravel(np.asarray(bound, np.float64)) for bound in (self.low, self.high))
        return low, high


def name_leaf(leaf: Leaf, of: str = "observation") -> str:
    """Return how to write the leaf of an observation or an action: `observation['camera'][0]`."""
    return of + "".join(f"[{key!r}]" for key in leaf.path)


def name_element(leaf: Leaf, index: int, of: str = "observation") -> str:
    """Return how to write one number of a leaf, given by its flat index: `observation['camera'][3, 0, 2]`."""
    where = name_leaf(leaf, of)
    if not leaf.shape:
        return where
    position = np.unravel_index(index, leaf.shape)
    return f"{where}[{', '.join(str(int(i)) for i in position)}]"


def find_leaves(space: Any, path: Path = ()) -> list[Leaf]:
    """Take a space apart; what is not a known space becomes a leaf that is not supported."""
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        return [leaf for key, value in space.spaces.items() for leaf in find_leaves(value, (*path, key))]
    if isinstance(space, spaces.Tuple):
        return [leaf for i, value in enumerate(space.spaces) for leaf in find_leaves(value, (*path, i))]
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


def flatten_action(leaves: list[Leaf], action: Any) -> NDArray[np.float64]:
    """Return an action's numbers in the order of the action space's leaves; those of unknown kinds are left out."""
    parts = [np.ravel(pick(action, leaf.path)).astype(np.float64) for leaf in leaves if leaf.supported]
    return np.concatenate(parts) if parts else np.zeros(0)


def flatten_numbers(observation: Any) -> NDArray[Any]:
    """Return a copy of all numbers of an observation; those that are in no array of numbers are left out."""
    if isinstance(observation, dict):
        observation = tuple(observation.values())
    if isinstance(observation, (tuple, list)) and any(isinstance(part, (np.ndarray, dict)) for part in observation):
        parts = [flatten_numbers(value) for value in observation]
        return np.concatenate(parts) if parts else np.zeros(0)
    try:
        array = np.array(observation)
    except Exception:  # a ragged list, or an object of its own kind
        array = np.zeros(0)
    return array.ravel() if array.dtype.kind in "biuf" else np.zeros(0)


def find_numbers(info: dict[Any, Any]) -> Iterator[tuple[str, float]]:
    """Yield the numbers of an info by name; those in a dictionary of it as `reward_terms/distance`."""
    for key, value in info.items():
        inner = value.items() if isinstance(value, dict) else [("", value)]
        for name, number in inner:
            # Some libraries make an array without axes of a comparison.
            is_scalar = isinstance(number, np.ndarray) and number.shape == () and number.dtype.kind in "biuf"
            if isinstance(number, NUMBERS) or is_scalar:
                with contextlib.suppress(OverflowError):  # a whole number of hundreds of digits
                    yield f"{key}/{name}" if isinstance(value, dict) else str(key), float(number)


def name_type(value: Any) -> str:
    """Return a type as a user would write it: `numpy.bool`, `list`."""
    kind = type(value)
    return kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"


def read_flag(flag: Any) -> bool:
    """Return what a flag means, whatever its type; False for what has no truth, and any of a flag per agent."""
    if isinstance(flag, bool):  # nearly always; asking numpy takes a tenth of a robot's step
        return flag
    try:
        return bool(np.any(list(flag.values()) if isinstance(flag, dict) else flag))
    except Exception:  # its type is noted, and is a finding
        return False
