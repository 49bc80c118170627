"""Actors by name: zero and random actions, a function that a user writes, an exported file."""

import copy
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.environments import registry
from rlctl.environments.dict_spaces import format_space, map_parts
from rlctl.errors import (
    NoSuchClassError,
    PolicyError,
    RlctlError,
    UsageError,
    describe_exception,
    did_you_mean,
    find_plugin_line,
    short_repr,
)
from rlctl.policy.actor import Actor, Array, Rows, act_one_by_one, as_stored
from rlctl.policy.load import load_actor
from rlctl.policy.noise import make_generator

BASELINES = ("zero", "random")
SERVER = ("ws://", "wss://")
"""Prefixes of the address of a policy server; its actor is `rlctl.play.remote.RemoteActor`."""


def make_actor(name: str, space: spaces.Space[Any], count: int = 1) -> Actor:
    """Return the actor for `zero`, `random`, a file, or the name of a function, see `load_function`.

    `space` is the action space, `count` the number of environments.
    """
    if name == "zero":
        return ZeroActor(space)
    if name == "random":
        return RandomActor(space)
    return FunctionActor(name, space) if ":" in Path(name).name else load_actor(Path(name), count)


Act = Callable[[Any, int], Any]
"""A user's function: from an observation and the number of steps so far to an action."""


def load_function(text: str) -> Act:
    """Import `module:function` or `path/to/file.py:function`: `act(observation)` or `act(observation, step)`.

    Raises `UsageError` for text without such a function, `TaskError` for a file whose import fails.
    """
    if ":" not in text:
        close = did_you_mean(text, BASELINES)
        raise UsageError(f"--policy {text}: give zero, random, MODULE:FUNCTION or PATH.py:FUNCTION.{close}")
    try:
        return _accept_step(registry.load(text))
    except NoSuchClassError:
        place, _, name = text.rpartition(":")
        raise UsageError(f"--policy {text}: {place} has no function {name!r}") from None
    except RlctlError as error:
        problem = str(error).removeprefix(f"task {text!r}: ").removeprefix(f"--policy {text}: ")
        raise type(error)(f"--policy {text}: {problem}", details=error.details) from None


def _accept_step(function: Callable[..., Any]) -> Act:
    """Return a function of two arguments; the user's receives the step if it needs two, or has one called `step`."""
    try:
        signature = inspect.signature(function)
    except (ValueError, TypeError):  # not written in Python
        return lambda observation, step: function(observation)
    if "step" not in signature.parameters and _takes(signature, 1):
        return lambda observation, step: function(observation)
    if _takes(signature, 2):
        return function
    raise UsageError(f"its parameters are {signature}; write (observation) or (observation, step)")


def _takes(signature: inspect.Signature, count: int) -> bool:
    try:
        signature.bind(*range(count))
    except TypeError:
        return False
    return True


class ZeroActor(Actor):
    """Takes the action 0, clipped to the action space; for discrete actions the first."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        if isinstance(space, spaces.Box):
            self.action: Array = np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        else:
            self.action = np.full(space.shape or (), getattr(space, "start", 0), np.int64)

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the same action at every step."""
        actions = np.repeat(self.action[None], len(rows), axis=0)
        return as_stored(actions), actions


class RandomActor(Actor):
    """Takes uniformly random actions."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self._space = copy.deepcopy(space)  # the environment may draw from its own

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return actions that depend only on seed and step."""
        return act_one_by_one(observations, rows, self._draw)

    def _draw(self, observation: Any, row: int, seed: int, step: int) -> Any:
        self._space.seed(int(make_generator(seed, 0, step).integers(2**31)))
        return self._space.sample()


class FunctionActor(Actor):
    """Takes the actions that a user's function returns; actions of a Box are clipped to its bounds."""

    def __init__(self, name: str, space: spaces.Space[Any]) -> None:
        self._function = load_function(name)
        place, _, function = name.rpartition(":")
        self._name = f"{Path(place).name}:{function}"
        self._space = space

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Call the function for each row; raises `PolicyError` if it raises, or returns no action of the space."""
        return act_one_by_one(observations, rows, self._call)

    def _call(self, observation: Any, row: int, seed: int, step: int) -> Any:
        try:
            result = self._function(map_parts(np.copy, observation), step)
        except (Exception, SystemExit) as error:
            what = f"{describe_exception(error)}{find_plugin_line(error)}"
            raise PolicyError(f"policy {self._name}, step {step}: {what}") from error
        return self._check(result, step)

    def _check(self, result: Any, step: int) -> Any:
        space, shape = self._space, self._space.shape or ()
        try:
            action = np.asarray(result, space.dtype)
        except (ValueError, TypeError):
            action = None
        returned = f"returned {short_repr(result)}"
        if action is not None and result is not None:
            if action.shape != shape:
                returned = f"returned shape {action.shape}, expected {shape}: {short_repr(result)}"
            elif isinstance(space, spaces.Box) and np.isfinite(action).all():
                return np.clip(action, space.low, space.high)
            elif space.contains(action if space.shape else action[()]):
                return action
        raise PolicyError(f"policy {self._name}, step {step}: it {returned}; the action space is {format_space(space)}")
