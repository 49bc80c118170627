"""`GymWorlds`: any Gymnasium environment as worlds with one row; checks everything that it returns."""

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, join, split, split_space
from rlctl.environments.success import SUCCESS, find_success
from rlctl.environments.teacher_wrapper import TeacherWrapper
from rlctl.output import format_count
from rlctl.task.calls import ONE_FLAG
from rlctl.task.env import TaskEnv
from rlctl.task.worlds import EpisodeTotals, WorldsStep

_FEW = 32  # numbers that Python adds faster than NumPy
_STEP = ("observation", "reward", "terminated", "truncated", "info")
_RESET = ("observation", "info")


class GymWorlds:
    """One world: a Gymnasium environment, or a task in wrappers that change what it observes."""

    count = 1

    def __init__(self, env: Any, level: float = 1.0) -> None:
        self.env, self.level = env, level
        self.observation_space, self.action_space = env.observation_space, env.action_space
        inner = env.unwrapped
        self.task_worlds = inner.worlds if isinstance(inner, TaskEnv) else None
        """The worlds of the task inside the wrappers; None for a plain environment."""
        self.weights: Mapping[str, float] = {} if self.task_worlds is None else self.task_worlds.weights
        self.step_of = np.zeros(1, np.int64)
        self._is_discrete = isinstance(env.action_space, spaces.Discrete)
        self._writer = ObservationCheck(env.observation_space)
        self._reward, self._sums = 0.0, dict[str, float]()
        self.info: Mapping[str, Any] = {}
        """What the last reset or step returned beside the rest."""
        self._no_terms = np.zeros((1, 0))
        self._teacher = _find_teacher_wrapper(env)

    def reset(self, worlds: NDArray[np.int64], seeds: Sequence[int], levels: NDArray[np.float64] | None = None) -> Any:
        """Begin the episode of a seed, of a task at this level; return its first observation, shape (1, ...)."""
        self.step_of[0] = 0
        self._reward, self._sums, self.info = 0.0, {}, {}
        if self.task_worlds is not None:
            self.task_worlds.level = self.level if levels is None else float(levels[0])
        observation, info = _check_tuple(self.env.reset(seed=int(seeds[0])), _RESET, "reset")
        _check_info(info)
        self.info = info
        return self._writer.read(observation)

    def next_level(self, world: int) -> float | None:
        """Return the level of the next episode of a task that chooses it; None otherwise."""
        return None if self.task_worlds is None else self.task_worlds.next_level(0)

    def shorten(self, worlds: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """Truncate the next episode of a task after so many steps; a plain environment has a time limit of its own."""
        if self.task_worlds is not None:
            self.task_worlds.shorten(worlds, limits)

    def step(self, action: Any, worlds: NDArray[np.int64] | None = None) -> WorldsStep:
        """Take a step with an action of shape (1, ...)."""
        self.step_of[0] += 1
        chosen = int(action[0]) if self._is_discrete else np.array(action[0])
        observation, reward, terminated, truncated, info = _check_tuple(self.env.step(chosen), _STEP, "step")
        reward = _to_float(reward, "reward")
        if not math.isfinite(reward):
            raise ValueError(f"reward is {reward}")
        _check_info(info)
        flags = ONE_FLAG[_to_bool(terminated, "terminated")], ONE_FLAG[_to_bool(truncated, "truncated")]
        self.info = info
        self._reward += reward
        if "reward_terms" in info:
            self._add_terms(info["reward_terms"])
        raw = np.array([list(info["metrics"].values())]) if self.weights else self._no_terms
        success = _read_success(info)
        successes = None if success is None else ONE_FLAG[success]
        return WorldsStep(self._writer.read(observation), np.array([reward]), *flags, raw, successes)

    def _add_terms(self, terms: Any) -> None:
        sums = self._sums
        try:
            for name, value in terms.items():
                sums[name] = sums.get(name, 0.0) + value
        except (TypeError, AttributeError):
            raise ValueError(f"info['reward_terms'] is {terms!r}, not a dict of numbers") from None

    def totals(self, world: int = 0) -> EpisodeTotals:
        """Return what the episode has added up to so far."""
        if self.task_worlds is not None:
            return self.task_worlds.totals(0)
        metrics = self.info.get("metrics")
        # In a plain environment "metrics" and "distance" may be anything.
        distance = (metrics if isinstance(metrics, dict) else self.info).get("distance")
        if not isinstance(distance, int | float | np.number) or not math.isfinite(distance):
            distance = None
        return EpisodeTotals(
            reward=self._reward,
            terms={str(name): _to_float(value, f"reward term {name}") for name, value in self._sums.items()},
            metrics={},
            distance=None if distance is None else float(distance),
            success=_read_success(self.info),
            drawn={},
        )

    @property
    def compute_reward(self) -> Any:
        """The environment's method for other goals; raises `AttributeError` if it has none."""
        return self.env.unwrapped.compute_reward

    def deepest_contact(self, world: int) -> float:
        """Return how far two bodies overlap at most now [m]."""
        return 0.0 if self.task_worlds is None else self.task_worlds.deepest_contact(0)

    def observe_privileged(self, worlds: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return what only the critic sees; a plain environment has nothing of the kind."""
        assert self.task_worlds is not None
        return self.task_worlds.observe_privileged(worlds)

    def teacher_sees(self, worlds: NDArray[np.int64]) -> Any:
        """Return what the teacher sees now, shape (1, ...)."""
        assert self._teacher is not None
        return join({key: np.asarray(part)[None] for key, part in split(self._teacher.seen).items()})

    @property
    def teacher_sizes(self) -> Mapping[str, int]:
        """Elements per name of what the teacher sees, without its wrappers; empty for a plain environment."""
        assert self._teacher is not None
        return self._teacher.sizes

    @property
    def teacher_space(self) -> spaces.Space[Any]:
        """The space of what the teacher sees."""
        assert self._teacher is not None
        return self._teacher.teacher_space

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _find_teacher_wrapper(env: Any) -> TeacherWrapper | None:
    while hasattr(env, "env"):
        if isinstance(env, TeacherWrapper):
            return env
        env = env.env
    return None


def _check_tuple(returned: Any, names: tuple[str, ...], call: str) -> Any:
    if isinstance(returned, tuple | list) and len(returned) == len(names):
        return returned
    what = format_count(len(returned), "value") if isinstance(returned, tuple | list) else reprlib.repr(returned)
    raise ValueError(f"{call} returned {what}; Gymnasium requires ({', '.join(names)})")


def _to_float(value: Any, name: str) -> float:
    if value.__class__ is float:
        exact: float = value
        return exact
    try:
        if isinstance(value, str | bytes):
            raise TypeError
        return float(value.item() if isinstance(value, np.ndarray) else value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {reprlib.repr(value)}, not a number") from None


def _read_success(info: Mapping[str, Any]) -> bool | None:
    success = find_success(info)
    return None if success is None else _to_bool(success, f"info['{SUCCESS}']")


def _to_bool(value: Any, name: str) -> bool:
    """Return a flag as a bool; NumPy's bools and the numbers 0 and 1 are accepted."""
    if value.__class__ is bool:
        exact: bool = value
        return exact
    if np.size(value) == 1 and (single := np.ravel(value)[0]) in (0, 1):
        return bool(single)
    raise ValueError(f"{name} is {reprlib.repr(value)}, not a bool")


def _check_info(info: Any) -> None:
    if info.__class__ is not dict and not isinstance(info, Mapping):  # the second takes longer
        raise ValueError(f"info is {reprlib.repr(info)}, not a dict")


class _Field(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    categories: NDArray[Any] | None  # the first and the last one


class ObservationCheck:
    """Reads observations of an environment's space as rows."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self._fields: dict[str, _Field] = {}
        for key, part in _flatten_space(space).items():
            if part.shape is None or part.dtype is None:
                raise TypeError(f"{type(part).__name__} inside a Dict space is not supported")
            self._fields[key] = _Field(part.shape, np.dtype(part.dtype), _category_bounds(part))
        self._is_single = SINGLE in self._fields

    def read(self, observation: Any) -> Any:
        """Return a copy of an observation with a leading axis; raises `ValueError` for one that does not fit.

        A Dict inside a Dict becomes keys such as `achieved_goal/kettle`.
        """
        if self._is_single and observation.__class__ is np.ndarray:
            return self._read_part(SINGLE, observation)
        parts = split(observation)
        if isinstance(observation, dict) and any(isinstance(part, dict) for part in observation.values()):
            parts = _flatten(observation)
        if parts.keys() != self._fields.keys():
            raise ValueError(f"observation has the keys {sorted(parts)}, the space has {sorted(self._fields)}")
        return join({key: self._read_part(key, np.asarray(parts[key])) for key in self._fields})

    def _read_part(self, key: str, value: NDArray[Any]) -> NDArray[Any]:
        shape, dtype, limits = self._fields[key]
        if value.shape != shape:
            raise ValueError(f"{_named(key)} has shape {value.shape}, the space has {shape}")
        if value.dtype is not dtype and value.dtype.kind not in "biuf":
            raise ValueError(f"{_named(key)} is {reprlib.repr(value.tolist())}, not numbers")
        # The sum is finite if all elements are, unless it overflows: then the slow check decides.
        if value.dtype.kind == "f" and not math.isfinite(_sum(value)):
            bad = np.flatnonzero(~np.isfinite(value))
            if bad.size:
                raise ValueError(f"{_named(key)} is not finite: element {bad[0]} is {value.ravel()[bad[0]]}")
        if limits is not None and not ((limits[0] <= value) & (value <= limits[1])).all():
            raise ValueError(f"{_named(key)} is {value}, the space has {limits[0]} to {limits[1]}")
        return np.array(value, dtype)[None]


def _sum(values: NDArray[Any]) -> Any:
    if values.size <= _FEW:  # a third of the time, and no warning of NumPy
        return sum(values.ravel().tolist())
    return np.add.reduce(values, None)


def _flatten_space(space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    parts: dict[str, spaces.Space[Any]] = {}
    for key, part in split_space(space).items():
        if isinstance(part, spaces.Dict):
            parts |= {f"{key}/{name}": inner for name, inner in _flatten_space(part).items()}
        else:
            parts[key] = part
    return parts


def _flatten(observation: Mapping[str, Any]) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for key, part in observation.items():
        if isinstance(part, dict):
            parts |= {f"{key}/{name}": inner for name, inner in _flatten(part).items()}
        else:
            parts[key] = part
    return parts


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
