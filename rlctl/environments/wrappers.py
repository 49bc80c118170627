"""Wrappers around an environment: time left as an observation, stacked frames, and time limits found in them."""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, TimeLimit, TransformObservation

from rlctl.environments.dict_spaces import LARGEST_SPACE
from rlctl.errors import RecipeError, check_name
from rlctl.task.env import TaskEnv

NAME = "time_left"  # name of the added observation
_KEY = "observation"  # the entry of a Dict space to which it is appended


class TimeFeature(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Appends the remaining fraction of the time limit to a flat observation: 1 at the reset, 0 at the limit.

    In a Dict space it is appended to the entry `observation`. Equal to sb3-contrib's `TimeFeatureWrapper`, which
    rl-zoo3's locomotion agents use; that one imports torch.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        inner = env.unwrapped
        limit = inner.max_steps if isinstance(inner, TaskEnv) else find_time_limit(env)
        if not limit:
            name = type(inner).__name__
            raise RecipeError(f"time_feature: {name} has no time limit, so there is no remaining time to observe")
        self._limit = limit
        self._steps = 0
        space = env.observation_space
        if isinstance(space, spaces.Dict) and _KEY in space.spaces:
            self.observation_space = spaces.Dict([*{**space.spaces, _KEY: _append_bounds(space[_KEY])}.items()])
        else:
            self.observation_space = _append_bounds(space)

    def extend_sizes(self, sizes: dict[str, int]) -> dict[str, int]:
        """Return a task's observation sizes by name, with the time added."""
        if isinstance(self.observation_space, spaces.Dict):
            return {**sizes, _KEY: sizes[_KEY] + 1}
        return {**sizes, NAME: 1}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._steps = 0
        observation, info = self.env.reset(seed=seed, options=options)
        return self._append(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        self._steps += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._append(observation), reward, terminated, truncated, info

    def _append(self, observation: Any) -> Any:
        left = 1 - self._steps / self._limit
        if isinstance(self.observation_space, spaces.Dict):
            return {**observation, _KEY: np.append(observation[_KEY], left).astype(self.observation_space[_KEY].dtype)}
        return np.append(observation, left).astype(self.observation_space.dtype)


def _append_bounds(space: spaces.Space[Any]) -> spaces.Box:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.dtype.kind != "f":
        raise RecipeError(f"time_feature: only flat observations of real numbers can have it, this task has {space}")
    low, high = (np.append(bounds, end).astype(space.dtype) for bounds, end in ((space.low, 0), (space.high, 1)))
    return spaces.Box(low, high, dtype=space.dtype.type)


def find_time_feature(env: gymnasium.Env[Any, Any]) -> TimeFeature | None:
    """Return the environment's `TimeFeature` wrapper, or None."""
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeFeature):
            return env
        env = env.env
    return None


def find_time_limit(env: Any) -> int | None:
    """Return the number of steps after which a `TimeLimit` or the registration truncates an episode, or None.

    A limit inside the environment's own code is not known.
    """
    spec = getattr(env, "spec", None)
    limits = [spec.max_episode_steps] if spec and spec.max_episode_steps else []
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit):
            limits.append(env._max_episode_steps)  # Gymnasium offers no other way
        env = env.env
    return min(limits, default=None)


def select_observations(env: gymnasium.Env[Any, Any], names: Sequence[str]) -> gymnasium.Env[Any, Any]:
    """Observe some entries of a Dict space by name, or some elements of a flat observation by number, from 0."""
    space, what = env.observation_space, f"observe: {type(env.unwrapped).__name__} has no"
    if isinstance(space, spaces.Dict):
        for name in names:
            check_name(name, space.spaces, f"{what} observation", RecipeError)
        kept = {key: part for key, part in space.spaces.items() if key in names}
        selected = spaces.Dict([*kept.items()])  # pairs, because Gymnasium sorts a mapping by key
        return TransformObservation(env, lambda observation: {key: observation[key] for key in kept}, selected)
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise RecipeError(
            f"observe: only of flat observations and of Dict spaces a part can be observed, not of {space}"
        )
    for name in names:
        check_name(name, map(str, range(space.shape[0])), f"{what} element", RecipeError)
    columns = sorted({int(name) for name in names})
    flat = spaces.Box(space.low[columns], space.high[columns], dtype=space.dtype.type)
    return TransformObservation(env, lambda observation: np.asarray(observation)[columns], flat)


def stack_frames(env: gymnasium.Env[Any, Any], frames: int) -> gymnasium.Env[Any, Any]:
    """Observe the last `frames` observations, oldest first, along the last axis."""
    space = env.observation_space
    inner = env.unwrapped
    if isinstance(inner, TaskEnv) and (history := inner.view.frames):
        raise RecipeError(f"frame_stack: the task declares a history of {', '.join(history)}; set frame_stack: 1")
    if not isinstance(space, spaces.Box) or len(space.shape) not in (1, 3):
        raise RecipeError(f"frame_stack: only flat and image observations can be stacked, this task has {space}")
    if (count := math.prod(space.shape) * frames) > LARGEST_SPACE:
        raise RecipeError(f"frame_stack: {frames:,} makes {count:,} elements; at most {LARGEST_SPACE:,} are supported")
    # Gymnasium stacks along a new first axis; networks want vectors and images of the same rank.
    low, high = (np.concatenate([bounds] * frames, axis=-1) for bounds in (space.low, space.high))
    flat = spaces.Box(low, high, dtype=space.dtype.type)
    stacked = FrameStackObservation(env, frames)
    return TransformObservation(stacked, lambda stack: np.concatenate(list(stack), axis=-1), flat)
