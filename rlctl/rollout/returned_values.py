"""What environments return, checked as it comes, so that what is wrong is named and not left to what breaks on it."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

STEP = ("observation", "reward", "terminated", "truncated", "info")
RESET = ("observation", "info")


class InvalidReturn(ValueError):
    """An environment returned a value that contradicts its spaces or Gymnasium's interface."""


def check_tuple(returned: Any, names: tuple[str, ...], call: str) -> Any:
    """Return what a call gave back if it is a tuple with a value for each name."""
    if isinstance(returned, tuple | list) and len(returned) == len(names):
        return returned
    if isinstance(returned, tuple | list):
        what = f"{len(returned)} value{'' if len(returned) == 1 else 's'}"
    else:
        what = reprlib.repr(returned)
    raise InvalidReturn(f"{call} returned {what}, and not ({', '.join(names)}), as Gymnasium requires")


def to_float(value: Any, name: str) -> float:
    """Return a reward, or what else must be a number, as a float."""
    try:
        if isinstance(value, str | bytes):
            raise TypeError
        return float(value.item() if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError):
        raise InvalidReturn(f"{name} is {reprlib.repr(value)}, not a number") from None


def to_bool(value: Any, name: str) -> bool:
    """Return `terminated` or `truncated` as a bool; numpy's bools and numbers 0 and 1 are accepted."""
    if np.size(value) == 1 and (single := np.ravel(value)[0]) in (0, 1):
        return bool(single)
    raise InvalidReturn(f"{name} is {reprlib.repr(value)}, not a bool")


def check_info(info: Any) -> None:
    """Raise `InvalidReturn` if an info is not a dictionary."""
    if not isinstance(info, Mapping):
        raise InvalidReturn(f"info is {reprlib.repr(info)}, not a dict")


def check_numeric(value: NDArray[Any], what: str) -> None:
    """Raise `InvalidReturn` if the elements of an observation are not numbers."""
    if value.dtype.kind not in "biuf":
        raise InvalidReturn(f"{what} is {reprlib.repr(value.tolist())}, not numbers")


def find_not_finite(value: NDArray[Any], what: str) -> InvalidReturn | None:
    """Return the error of an observation that has an element that is not finite."""
    bad = np.flatnonzero(~np.isfinite(value))
    if not bad.size:
        return None
    return InvalidReturn(f"{what} is not finite: element {bad[0]} is {value.ravel()[bad[0]]}")


def category_bounds(space: spaces.Space[Any]) -> NDArray[Any] | None:
    """Return the first and last value, shape (2, ...), of a space of categories: a network cannot take others."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.start, space.start + space.n - 1])
    if isinstance(space, spaces.MultiDiscrete):
        start = np.asarray(space.start)
        return np.stack([start, start + space.nvec - 1])
    return None
