"""Checks the values that environments return, so that an error names the wrong value."""

import math
import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, split, split_space
from rlctl.errors import TaskError, describe_exception, format_plugin_traceback
from rlctl.output import format_count
from rlctl.rollout.shared_arrays import observation_fields

STEP = ("observation", "reward", "terminated", "truncated", "info")
RESET = ("observation", "info")


class InvalidReturn(ValueError):
    """An environment returned a value that contradicts its spaces or Gymnasium's interface."""


def check_tuple(returned: Any, names: tuple[str, ...], call: str) -> Any:
    """Return the result of a call if it is a tuple with a value for each name, else raise `InvalidReturn`."""
    if isinstance(returned, tuple | list) and len(returned) == len(names):
        return returned
    what = format_count(len(returned), "value") if isinstance(returned, tuple | list) else reprlib.repr(returned)
    raise InvalidReturn(f"{call} returned {what}; Gymnasium requires ({', '.join(names)})")


def to_float(value: Any, name: str) -> float:
    """Return a number as a float; raises `InvalidReturn`, which mentions `name`, for anything else."""
    try:
        if isinstance(value, str | bytes):
            raise TypeError
        return float(value.item() if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError):
        raise InvalidReturn(f"{name} is {reprlib.repr(value)}, not a number") from None


def to_bool(value: Any, name: str) -> bool:
    """Return a flag as a bool; numpy's bools and the numbers 0 and 1 are accepted, else raises `InvalidReturn`."""
    if np.size(value) == 1 and (single := np.ravel(value)[0]) in (0, 1):
        return bool(single)
    raise InvalidReturn(f"{name} is {reprlib.repr(value)}, not a bool")


def check_info(info: Any) -> None:
    """Raise `InvalidReturn` if an info is not a dictionary."""
    if not isinstance(info, Mapping):
        raise InvalidReturn(f"info is {reprlib.repr(info)}, not a dict")


class ObservationWriter:
    """Checks observations and writes them into arrays, one per key; `checked`: the environment has checked them."""

    def __init__(self, space: spaces.Space[Any], *, checked: bool) -> None:
        self._checked = checked
        self._fields = observation_fields(space)
        self._categories = {key: _category_bounds(part) for key, part in split_space(space).items()}

    def write(self, target: Mapping[str, NDArray[Any]], index: int, observation: Any) -> None:
        """Write an observation into row `index` of each array; raises `InvalidReturn` for one that does not fit."""
        if self._checked:
            target[SINGLE][index] = observation
            return
        parts = split(observation)
        if parts.keys() != target.keys():
            raise InvalidReturn(f"observation has the keys {sorted(parts)}, the space has {sorted(target)}")
        for key, value in parts.items():
            value = np.asarray(value)
            self._check(key, value)
            target[key][index] = value

    def _check(self, key: str, value: NDArray[Any]) -> None:
        shape, dtype = self._fields[key]
        if value.shape != shape:
            raise InvalidReturn(f"{_named(key)} has shape {value.shape}, the space has {shape}")
        if value.dtype is not dtype and value.dtype.kind not in "biuf":
            raise InvalidReturn(f"{_named(key)} is {reprlib.repr(value.tolist())}, not numbers")
        # The sum is finite if all elements are, unless it overflows: then the slow check decides.
        if value.dtype.kind == "f" and not math.isfinite(np.add.reduce(value, None)):
            bad = np.flatnonzero(~np.isfinite(value))
            if bad.size:
                raise InvalidReturn(f"{_named(key)} is not finite: element {bad[0]} is {value.ravel()[bad[0]]}")
        limits = self._categories[key]
        if limits is not None and not ((limits[0] <= value) & (value <= limits[1])).all():
            raise InvalidReturn(f"{_named(key)} is {value}, the space has {limits[0]} to {limits[1]}")


def _named(key: str) -> str:
    return f"observation {key!r}" if key else "observation"


def _category_bounds(space: spaces.Space[Any]) -> NDArray[Any] | None:
    """Return the first and last value, shape (2, ...), of a space of categories; a network accepts no others."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.start, space.start + space.n - 1])
    if isinstance(space, spaces.MultiDiscrete):
        start = np.asarray(space.start)
        return np.stack([start, start + space.nvec - 1])
    return None


def compute_rewards(env: Any, achieved: NDArray[Any], desired: NDArray[Any]) -> NDArray[np.float64]:
    """Return the rewards, shape (n,), that an environment computes for goals of shape (n, *goal); else `TaskError`."""
    count = len(achieved)
    infos: list[dict[str, Any]] = [{} for _ in range(count)]
    try:
        rewards = np.asarray(env.unwrapped.compute_reward(achieved, desired, infos))
    except BaseException as error:  # a plugin may raise anything, SystemExit too
        raise TaskError(
            f"compute_reward raised {describe_exception(error)}", details=format_plugin_traceback(error)
        ) from error
    if rewards.dtype.kind not in "fiub":
        raise TaskError(f"compute_reward returned an array of {rewards.dtype}, not of numbers")
    if rewards.shape != (count,):
        raise TaskError(f"compute_reward returned shape {rewards.shape} for {count} goals at once, not ({count},)")
    if not np.isfinite(rewards).all():
        bad = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise TaskError(f"compute_reward is {rewards[bad]} for achieved {achieved[bad]}, desired {desired[bad]}")
    return rewards.astype(np.float64)
