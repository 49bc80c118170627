"""The description of an environment that policy files contain, as plain data: spaces, names, units, timing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import pydantic
from gymnasium import spaces

from rlctl.environments.dict_spaces import LARGEST_SPACE, format_space
from rlctl.errors import ArtifactError, UsageError, short_repr
from rlctl.task.motors import Joints

_ONE_HOT = 10  # each value of a discrete space counts as this many elements of a Box


class EnvInfo(pydantic.BaseModel):
    """Describes an environment; part of every policy file, ONNX file and run."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    observation_sizes: dict[str, int] = {}
    """Size per observation name, in the order of the flat observation; empty if the names are unknown."""
    observation_units: dict[str, str] = {}
    action_meaning: str = ""
    control_dt: float | None = None  # time between two actions [s]
    reward_weights: dict[str, float] = {}
    events: dict[str, bool] = {}  # the task's events (random changes), and whether each acts
    has_success: bool = False
    has_compute_reward: bool = False  # whether it has `compute_reward`, which hindsight replay needs
    max_steps: int | None = None
    robot: str = ""
    joints: Joints | None = None  # the joints that the action moves, if the task describes them

    def spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Return the observation and the action space."""
        return space_from_json(self.observation_space), space_from_json(self.action_space)

    def find_difference(self, other: EnvInfo, whose: str = "the environment's") -> str | None:
        """Describe how the spaces of `other` differ from these; None if they are equal."""
        for name in ("observation", "action"):
            ours, theirs = getattr(self, f"{name}_space"), getattr(other, f"{name}_space")
            if ours != theirs:
                own, foreign = (format_space(space_from_json(space), 120) for space in (ours, theirs))
                return f"its {name} space is {own}, {whose} is {foreign}"
        return None


def describe(env: gymnasium.Env[Any, Any]) -> EnvInfo:
    """Describe an environment; a `Task` also gives names, units and timing."""
    from rlctl.environments.mujoco_model import describe_model
    from rlctl.environments.wrappers import find_time_feature, find_time_limit
    from rlctl.task.env import TaskEnv

    inner = env.unwrapped
    common: dict[str, Any] = {
        "observation_space": space_to_json(env.observation_space),
        "action_space": space_to_json(env.action_space),
        "has_compute_reward": callable(getattr(inner, "compute_reward", None)),
    }
    if isinstance(inner, TaskEnv):
        task, time = inner.task, find_time_feature(env)
        sizes = inner.observation_sizes
        return EnvInfo(
            **common,
            observation_sizes=sizes if time is None else time.extend_sizes(sizes),
            observation_units=dict(task.observation_units),
            action_meaning=task.action_meaning,
            control_dt=task.control_dt,
            reward_weights=inner.reward_weights,
            events={name: name in inner.events for name in task.events},
            has_success=inner.has_success,
            max_steps=inner.max_steps,
            robot=task.robot,
            joints=task.describe_joints(),
        )
    return EnvInfo(**common, **describe_model(env), max_steps=find_time_limit(env))


def describe_randomization(events: Mapping[str, bool]) -> str:
    """Return `randomised by NAMES` or `not randomised`; empty for an environment without events."""
    if acting := [name for name, acts in events.items() if acts]:
        return f"randomised by {', '.join(acting)}"
    return "not randomised" if events else ""


def space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return a space as plain data; raises `UsageError` for a kind or size of space that policies do not support."""
    if isinstance(space, spaces.Box | spaces.MultiBinary) and math.prod(space.shape or ()) > LARGEST_SPACE:
        raise UsageError(
            f"a space of {math.prod(space.shape or ()):,} elements; at most {LARGEST_SPACE:,} are supported"
        )
    if isinstance(space, spaces.Box):
        return {
            "type": "Box",
            "low": _encode_bounds(space.low),
            "high": _encode_bounds(space.high),
            "shape": list(space.shape),
            "dtype": str(space.dtype),
        }
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else list(space.n)}
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": {key: space_to_json(value) for key, value in space.spaces.items()}}
    raise UsageError(
        f"the space {short_repr(space)} is not supported; "
        "Box, Discrete, MultiDiscrete of one axis, MultiBinary, Dict are"
    )


def _encode_bounds(values: Any) -> Any:
    # One number if all bounds are equal: images have many thousands. As text, because JSON has no infinity.
    flat = values.ravel()
    same = flat.size > 0 and bool((flat == flat[0]).all())  # np.unique would import numpy.ma, in every worker
    return _write_number(flat[0]) if same else [_write_number(number) for number in flat]


def _write_number(number: Any) -> str:
    # float64 holds no more than 53 bits: it reads the largest int64 as 2**63.
    is_exact = np.issubdtype(number.dtype, np.floating) or int(float(number)) == int(number)
    return repr(float(number)) if is_exact else str(int(number))


def _decode_bounds(value: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
    if isinstance(value, str):
        return np.full(shape, _read_number(value, dtype), dtype)
    return np.array([_read_number(text, dtype) for text in value], dtype).reshape(shape)


def _read_number(text: str, dtype: np.dtype[Any]) -> float:
    if dtype.kind in "bf":
        return float(text)
    # Earlier files have 2**63 for the largest int64.
    return int(text) if text.lstrip("-").isdecimal() else min(int(float(text)), int(np.iinfo(dtype).max))


def space_from_json(data: dict[str, Any]) -> spaces.Space[Any]:
    """Return the space that `space_to_json` encoded; raises `ArtifactError` for invalid or too large data."""
    try:
        if (count := _count_elements(data)) > LARGEST_SPACE:
            raise ValueError(f"{count:,} elements, at most {LARGEST_SPACE:,} are supported")
        return _build(data)
    except (KeyError, TypeError, ValueError, AttributeError, AssertionError, OverflowError, RecursionError) as error:
        raise ArtifactError(f"not a space: {short_repr(str(error) or error)}") from None


def _count_elements(data: dict[str, Any]) -> int:
    if data["type"] == "Dict":
        return sum(_count_elements(inner) for inner in data["spaces"].values())
    if data["type"] == "Box":
        return math.prod(_check_shape(data["shape"]))
    if data["type"] == "MultiBinary":
        return math.prod(_check_shape(data["n"]))
    # Networks get them one-hot encoded, 8 bytes per number, for a whole batch.
    alternatives = [data["n"]] if data["type"] == "Discrete" else data["nvec"]
    return _ONE_HOT * sum(_check_whole(count) for count in alternatives)


def _build(data: dict[str, Any]) -> spaces.Space[Any]:
    match data["type"]:
        case "Box":
            shape, dtype = _check_shape(data["shape"]), np.dtype(data["dtype"])
            if dtype.kind not in "biuf":
                raise ValueError(f"a Box of {dtype}")
            low, high = (_decode_bounds(data[end], shape, dtype) for end in ("low", "high"))
            return spaces.Box(low, high, shape, dtype.type)
        case "Discrete":
            return spaces.Discrete(_check_whole(data["n"]), start=_check_whole(data["start"]))
        case "MultiDiscrete":
            return spaces.MultiDiscrete(data["nvec"])
        case "MultiBinary":
            shape = _check_shape(data["n"])
            return spaces.MultiBinary(list(shape) if isinstance(data["n"], list) else shape[0])
        case "Dict":
            # Pairs, because Gymnasium sorts a mapping by key, and the order is part of the space.
            return spaces.Dict([(key, _build(value)) for key, value in data["spaces"].items()])
    raise ValueError(f"no type {short_repr(data['type'])}")


def _check_whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(f"expected a whole number, got {short_repr(value)}")
    return value


def _check_shape(sizes: Any) -> tuple[int, ...]:
    shape = tuple(_check_whole(size) for size in (sizes if isinstance(sizes, list) else [sizes]))
    if min(shape, default=0) < 0:
        raise ValueError(f"shape {short_repr(list(shape))}")
    return shape
