"""An environment in a worker and its running episode; checks the values that environments return."""

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, split, split_space
from rlctl.environments.spec import EnvSpec
from rlctl.errors import RecipeError, TaskError, describe_exception, format_plugin_traceback
from rlctl.output import format_count
from rlctl.play.messages import EpisodeResult
from rlctl.play.shared_arrays import CRITIC, observation_fields
from rlctl.task.env import TaskEnv

_STEP = ("observation", "reward", "terminated", "truncated", "info")
_RESET = ("observation", "info")


class RunningEpisode:
    """One environment and its episode; checks all returned values except observations."""

    def __init__(self, env: Any, index: int, metrics: Sequence[str] = ()) -> None:
        self.env = env
        self.index = index  # number of the environment
        self.write: Callable[[Mapping[str, NDArray[Any]], int, Any], None]
        """Writes an observation into row `index` of each array."""
        self._metrics = metrics  # reward terms of weight 0
        self._is_task = isinstance(env.unwrapped, TaskEnv)
        self._discrete = isinstance(env.action_space, spaces.Discrete)
        self._clear(-1)

    def _clear(self, seed: int) -> None:
        self.seed = seed
        self.step = 0  # steps begun in the episode
        self.acting_s, self.stepping_s = 0.0, 0.0
        """Time that the policy and the environment took in the episode's steps [s]."""
        self._return = 0.0
        self._sums: dict[str, float] = {}
        self._raw_sums = dict.fromkeys(self._metrics, 0.0)
        self._deepest_contact: float | None = None

    def start(self, seed: int, level: float) -> Any:
        """Begin the episode of a seed, of a task at this level; return its first observation."""
        self._clear(seed)
        if self._is_task:
            self.env.unwrapped.set_level(level)
        observation, info = _check_tuple(self.env.reset(seed=seed), _RESET, "reset")
        _check_info(info)
        return observation

    def take_step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment; return its checked result."""
        result = self.env.step(int(action) if self._discrete else action.copy())
        if result.__class__ is not tuple or len(result) != 5:
            result = _check_tuple(result, _STEP, "step")
        observation, reward, terminated, truncated, info = result
        if reward.__class__ is not float:
            reward = _to_float(reward, "reward")
        if not math.isfinite(reward):
            raise ValueError(f"reward is {reward}")
        if info.__class__ is not dict:
            _check_info(info)
        if terminated.__class__ is not bool or truncated.__class__ is not bool:
            terminated = _to_bool(terminated, "terminated")
            truncated = _to_bool(truncated, "truncated")
        self._count(reward, info)
        return observation, reward, terminated, truncated, info

    def _count(self, reward: float, info: dict[str, Any]) -> None:
        self._return += reward
        sums = self._sums
        try:
            for name, value in info.get("reward_terms", {}).items():
                sums[name] = sums.get(name, 0.0) + value
        except (TypeError, AttributeError):
            raise ValueError(f"info['reward_terms'] is {info['reward_terms']!r}, not a dict of numbers") from None
        for name in self._metrics:
            self._raw_sums[name] += info["metrics"][name]

    def measure_contact(self) -> None:
        """Update the largest overlap of bodies in this episode."""
        self._deepest_contact = max(self._deepest_contact or 0.0, self.env.unwrapped.sim.deepest_contact)

    def summarize(self, info: dict[str, Any], row: int, report: dict[str, Any]) -> EpisodeResult:
        """Return the result of the episode from the `info` of its last step, which is in a row of a segment."""
        success, metrics = info.get("is_success"), info.get("metrics")
        # In a plain environment "metrics" and "distance" may be anything.
        distance = (metrics if isinstance(metrics, dict) else info).get("distance")
        if not isinstance(distance, int | float | np.number) or not math.isfinite(distance):
            distance = None
        return EpisodeResult(
            self.index,
            self.seed,
            self._return,
            self.step,
            None if success is None else _to_bool(success, "info['is_success']"),
            {str(name): _to_float(value, f"reward term {name}") for name, value in self._sums.items()},
            None if distance is None else float(distance),
            row,
            report,
            self._deepest_contact,
            self.acting_s / max(self.acting_s + self.stepping_s, 1e-9),
            {name: float(total) / self.step for name, total in self._raw_sums.items()},
            dict(self.env.unwrapped.drawn) if self._is_task else {},
        )


def _check_tuple(returned: Any, names: tuple[str, ...], call: str) -> Any:
    if isinstance(returned, tuple | list) and len(returned) == len(names):
        return returned
    what = format_count(len(returned), "value") if isinstance(returned, tuple | list) else reprlib.repr(returned)
    raise ValueError(f"{call} returned {what}; Gymnasium requires ({', '.join(names)})")


def _to_float(value: Any, name: str) -> float:
    try:
        if isinstance(value, str | bytes):
            raise TypeError
        return float(value.item() if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {reprlib.repr(value)}, not a number") from None


def _to_bool(value: Any, name: str) -> bool:
    """Return a flag as a bool; NumPy's bools and the numbers 0 and 1 are accepted."""
    if np.size(value) == 1 and (single := np.ravel(value)[0]) in (0, 1):
        return bool(single)
    raise ValueError(f"{name} is {reprlib.repr(value)}, not a bool")


def _check_info(info: Any) -> None:
    if not isinstance(info, Mapping):
        raise ValueError(f"info is {reprlib.repr(info)}, not a dict")


class ObservationWriter:
    """Checks observations and writes them into arrays, one per key; `checked`: the environment has checked them."""

    def __init__(self, space: spaces.Space[Any], *, checked: bool) -> None:
        self._checked = checked
        self._fields = observation_fields(space)
        self._categories = {key: _category_bounds(part) for key, part in split_space(space).items()}

    def write(self, target: Mapping[str, NDArray[Any]], index: int, observation: Any) -> None:
        """Write an observation into row `index` of each array; raises `ValueError` for one that does not fit."""
        if self._checked:
            target[SINGLE][index] = observation
            return
        parts = split(observation)
        if parts.keys() != target.keys():
            raise ValueError(f"observation has the keys {sorted(parts)}, the space has {sorted(target)}")
        for key, value in parts.items():
            value = np.asarray(value)
            self._check(key, value)
            target[key][index] = value

    def _check(self, key: str, value: NDArray[Any]) -> None:
        shape, dtype = self._fields[key]
        if value.shape != shape:
            raise ValueError(f"{_named(key)} has shape {value.shape}, the space has {shape}")
        if value.dtype is not dtype and value.dtype.kind not in "biuf":
            raise ValueError(f"{_named(key)} is {reprlib.repr(value.tolist())}, not numbers")
        # The sum is finite if all elements are, unless it overflows: then the slow check decides.
        if value.dtype.kind == "f" and not math.isfinite(np.add.reduce(value, None)):
            bad = np.flatnonzero(~np.isfinite(value))
            if bad.size:
                raise ValueError(f"{_named(key)} is not finite: element {bad[0]} is {value.ravel()[bad[0]]}")
        limits = self._categories[key]
        if limits is not None and not ((limits[0] <= value) & (value <= limits[1])).all():
            raise ValueError(f"{_named(key)} is {value}, the space has {limits[0]} to {limits[1]}")


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


class CriticWriter:
    """Writes a task's observations with an `ObservationWriter`, and beside them what only the critic sees."""

    def __init__(self, writer: ObservationWriter, env: Any) -> None:
        self._writer, self._env = writer, env.unwrapped

    def write(self, target: Mapping[str, NDArray[Any]], index: int, observation: Any) -> None:
        """Write an observation into row `index` of each array."""
        self._writer.write(target, index, observation)
        target[CRITIC][index] = self._env.observe_privileged()


def show_critic(spec: EnvSpec, env: Any, privileged: Mapping[str, bool]) -> dict[str, int]:
    """Let an environment observe what only the critic sees; return its sizes by name, or raise `RecipeError`."""
    inner, space = env.unwrapped, env.observation_space
    if not isinstance(inner, TaskEnv):
        raise RecipeError(f"privileged: {spec.task} is a plain Gymnasium environment; only tasks have it")
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise RecipeError(
            f"privileged: {spec.task} observes {space}; a critic sees more only beside a flat observation"
        )
    inner.show_critic(**privileged)
    assert inner.privileged is not None
    return inner.privileged.sizes


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
