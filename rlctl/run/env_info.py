"""What a policy must know of its environment, as plain data: spaces, names, units, timing."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pydantic
from gymnasium import spaces

from rlctl.errors import ArtifactError, UsageError


class EnvInfo(pydantic.BaseModel):
    """Describes an environment; kept in every policy file, ONNX file and run."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    observation_sizes: dict[str, int] = {}
    """Size per observation name, in the order of the flat observation; empty where names are not known."""
    observation_units: dict[str, str] = {}
    action_meaning: str = ""
    control_dt: float | None = None
    """Time between two actions [s]."""
    reward_weights: dict[str, float] = {}
    has_success: bool = False
    has_compute_reward: bool = False
    """Whether it can say what a step would have been worth, had another goal been wanted."""
    max_steps: int | None = None
    robot: str = ""

    def spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Return the observation and the action space."""
        return space_from_json(self.observation_space), space_from_json(self.action_space)

    def difference(self, other: EnvInfo, whose: str = "the environment's") -> str | None:
        """Say how the spaces of `other` differ from these, in a few words; None if they do not."""
        for name in ("observation", "action"):
            ours, theirs = getattr(self, f"{name}_space"), getattr(other, f"{name}_space")
            if ours != theirs:
                return (
                    f"its {name} space is {_short(space_from_json(ours))}, {whose} is {_short(space_from_json(theirs))}"
                )
        return None


def _short(space: spaces.Space[Any]) -> str:
    text = " ".join(str(space).split())
    return text if len(text) <= 120 else f"{type(space).__name__}{space.shape or ''}"


def describe(env: gymnasium.Env[Any, Any]) -> EnvInfo:
    """Describe an environment; for a task with its names, units and timing."""
    from rlctl.task.env import TaskEnv

    inner = env.unwrapped
    common: dict[str, Any] = {
        "observation_space": space_to_json(env.observation_space),
        "action_space": space_to_json(env.action_space),
        "has_compute_reward": callable(getattr(inner, "compute_reward", None)),
    }
    if isinstance(inner, TaskEnv):
        task = inner.task
        return EnvInfo(
            **common,
            observation_sizes=inner.observation_sizes,
            observation_units=dict(task.observation_units),
            action_meaning=task.action_meaning,
            control_dt=task.control_dt,
            reward_weights=inner.reward_weights,
            has_success=inner.has_success,
            max_steps=inner.max_steps,
            robot=task.robot,
        )
    return EnvInfo(**common, max_steps=env.spec.max_episode_steps if env.spec else None)


def space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return a space as plain data; raises `UsageError` for a kind that no policy here can handle."""
    if isinstance(space, spaces.Box):
        return {
            "type": "Box",
            "low": _bound(space.low),
            "high": _bound(space.high),
            "shape": list(space.shape),
            "dtype": str(space.dtype),
        }
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else list(space.n)}
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": {key: space_to_json(value) for key, value in space.spaces.items()}}
    raise UsageError(
        f"spaces of type {type(space).__name__} are not supported; Box, Discrete, MultiDiscrete, MultiBinary, Dict are"
    )


def _bound(values: Any) -> Any:
    # One number where all are equal: images have many thousand bounds. Text, because JSON has no infinity.
    flat = [repr(float(v)) for v in np.unique(values)]
    return flat[0] if len(flat) == 1 else [repr(float(v)) for v in values.ravel()]


def _unbound(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    if isinstance(value, str):
        return np.full(shape, float(value)).astype(dtype)
    return np.array([float(v) for v in value]).reshape(shape).astype(dtype)


def space_from_json(data: dict[str, Any]) -> spaces.Space[Any]:
    """Return the space that `space_to_json` wrote; raises `ArtifactError` if it is not one."""
    try:
        kind = data["type"]
        if kind == "Box":
            shape, dtype = tuple(data["shape"]), np.dtype(data["dtype"])
            low, high = _unbound(data["low"], shape, dtype), _unbound(data["high"], shape, dtype)
            return spaces.Box(low, high, shape, dtype.type)
        if kind == "Discrete":
            return spaces.Discrete(data["n"], start=data["start"])
        if kind == "MultiDiscrete":
            return spaces.MultiDiscrete(data["nvec"])
        if kind == "MultiBinary":
            return spaces.MultiBinary(data["n"])
        if kind == "Dict":
            # Pairs: a mapping would be sorted by key, and the order is part of the space.
            return spaces.Dict([(key, space_from_json(value)) for key, value in data["spaces"].items()])
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        raise ArtifactError(f"not a space: {error!r}") from None
    raise ArtifactError(f"not a space: type {kind!r}")
