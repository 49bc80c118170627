"""The description of an environment that policy files contain, as plain data: spaces, names, units, timing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium
import numpy as np
import pydantic
from gymnasium import spaces

from rlctl.environments.dict_spaces import LARGEST_SPACE, SINGLE, format_space, split_space
from rlctl.environments.driven_joints import describe_driven_joints
from rlctl.environments.simulations import find_mujoco
from rlctl.errors import ArtifactError, OldGymError, TaskError, UsageError, short_repr
from rlctl.storage import validation
from rlctl.task.commands import CommandTerm
from rlctl.task.history import HistoryStart
from rlctl.task.joints import Joints
from rlctl.task.layout import Layout
from rlctl.task.terms import (
    ClipOrientation,
    Displacement,
    Distance,
    Euler,
    Gravity,
    LastAction,
    PhaseClock,
    Playback,
    Scaled,
    find_quantity_sizes,
)

if TYPE_CHECKING:
    from rlctl.environments.gym_worlds import GymWorlds
    from rlctl.environments.wrappers import TimeFeature
    from rlctl.task.worlds import TaskWorlds

AnyTerm = Annotated[
    Scaled | Gravity | Euler | Displacement | Distance | LastAction | PhaseClock | Playback | ClipOrientation,
    pydantic.Field(discriminator="kind"),
]
_ONE_HOT = 10  # each value of a discrete space counts as this many elements of a Box


class EnvInfo(pydantic.BaseModel):
    """Describes an environment; part of every policy file, ONNX file and run."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    observation_sizes: dict[str, int] = {}
    """Size per observation name, in the order of the flat observation; empty if the names are unknown."""
    observation_units: dict[str, str] = {}
    observation_history: dict[str, int] = {}
    """Number of last values, oldest first, of the observations that are histories; their sizes include all."""
    history_start: HistoryStart = "first"  # what fills histories when an episode begins
    observation_terms: dict[str, AnyTerm] = {}  # observations that are computed from measured quantities
    quantity_sizes: dict[str, int] = {}
    """Size per measured quantity of the terms, in the order of the terms and of their inputs."""
    command_ranges: dict[str, tuple[float, float]] = {}  # lowest and highest value of what a person may command
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

    @property
    def layout(self) -> Layout:
        """Where its named observations, and the values of their histories, are in the flat one."""
        return Layout(self.observation_sizes, self.observation_history)

    def find_sizes(self, frames: int = 1) -> dict[str, int]:
        """Return the elements of each named observation, or key of a Dict, in one of the `frames` of a stack.

        Where the names are unknown, all elements are `observation`.
        """
        parts = split_space(self.spaces()[0])
        of_keys = {key: math.prod(part.shape or ()) for key, part in parts.items()}
        total = sum(of_keys.values()) // frames
        sizes = dict(self.observation_sizes) if SINGLE in parts else of_keys
        return sizes if sum(sizes.values()) == total else {"observation": total}

    def find_difference(self, other: EnvInfo, whose: str = "the environment's") -> str | None:
        """Describe how the spaces of `other` differ from these; None if they are equal."""
        for name in ("observation", "action"):
            ours, theirs = getattr(self, f"{name}_space"), getattr(other, f"{name}_space")
            if ours != theirs:
                own, foreign = (format_space(space_from_json(space), 120) for space in (ours, theirs))
                return f"its {name} space is {own}, {whose} is {foreign}"
        own, foreign = (", ".join(info.observation_sizes) for info in (self, other))
        if own != foreign and sorted(self.observation_sizes) == sorted(other.observation_sizes):
            return f"its observations are in the order {own}, {whose} in the order {foreign}"
        if (ours := self._describe_history()) != (theirs := other._describe_history()):
            return f"its observations have {ours}, {whose} have {theirs}"
        return None

    def list_other_meanings(self, other: EnvInfo) -> list[str]:
        """Describe what has another name, unit or meaning in `other`, whose spaces are equal."""
        own, theirs = self.observation_sizes, other.observation_sizes
        if list(own.values()) == list(theirs.values()):
            changes = [f"{now} was {was}" for was, now in zip(own, theirs, strict=True) if was != now]
        else:
            changes = [f"the observations are {', '.join(theirs)}, and were {', '.join(own)}"]
        for name, unit in self.observation_units.items():
            if name in other.observation_units and other.observation_units[name] != unit:
                changes.append(f"{name} is in {other.observation_units[name]}, and was in {unit}")
        if self.action_meaning != other.action_meaning and self.action_meaning and other.action_meaning:
            changes.append(f"actions are {other.action_meaning!r}, and were {self.action_meaning!r}")
        return changes

    def _describe_history(self) -> str:
        counts = {name: count for name, count in self.observation_history.items() if count > 1}
        listed = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
        return f"a history of {listed} that begins with {self.history_start}" if counts else "no history"


def describe(env: gymnasium.Env[Any, Any]) -> EnvInfo:
    """Describe an environment; a `Task` also gives names, units and timing."""
    from rlctl.environments.wrappers import find_time_feature, find_time_limit
    from rlctl.task.env import TaskEnv

    inner = env.unwrapped
    common: dict[str, Any] = {
        "observation_space": space_to_json(env.observation_space),
        "action_space": space_to_json(env.action_space),
        "has_compute_reward": callable(getattr(inner, "compute_reward", None)),
    }
    if isinstance(inner, TaskEnv):
        return _describe_task(inner.worlds, common, find_time_feature(env))
    values = {**common, **describe_model(env), "max_steps": find_time_limit(env)}
    return validation.build(EnvInfo, values, TaskError, type(inner).__name__)


def describe_worlds(worlds: TaskWorlds | GymWorlds) -> EnvInfo:
    """Describe one world of several; see `describe`."""
    from rlctl.environments.gym_worlds import GymWorlds

    if isinstance(worlds, GymWorlds):
        return describe(worlds.env)
    common = {
        "observation_space": space_to_json(worlds.observation_space),
        "action_space": space_to_json(worlds.action_space),
        "has_compute_reward": worlds.compute_reward is not None,
    }
    return _describe_task(worlds, common, None)


def _describe_task(worlds: TaskWorlds, common: Mapping[str, Any], time: TimeFeature | None) -> EnvInfo:
    task = worlds.task
    sizes = worlds.view.sizes
    terms = {name: term for name, term in task.observation_terms.items() if name in sizes}
    quantities = {name for term in terms.values() for name in term.inputs}
    units = {name: unit for name, unit in task.observation_units.items() if name in sizes or name in quantities}
    values = {
        **common,
        "observation_sizes": sizes if time is None else time.extend_sizes(sizes),
        "observation_units": units,
        "observation_history": worlds.view.frames,
        "history_start": task.history_start,
        "observation_terms": terms,
        "quantity_sizes": find_quantity_sizes(terms, worlds.measured_of(0)),
        "command_ranges": _find_command_ranges(task.commands()),
        "action_meaning": task.action_meaning,
        "control_dt": task.control_dt,
        "reward_weights": worlds.weights,
        "events": {name: name in worlds.events for name in task.events},
        "has_success": worlds.has_success,
        "max_steps": worlds.max_steps,
        "robot": type(task).robot,
        "joints": task.describe_joints(),
    }
    return validation.build(EnvInfo, values, TaskError, type(task).__name__)


def _find_command_ranges(commands: Mapping[str, CommandTerm]) -> dict[str, tuple[float, float]]:
    ranges = {name: (float(term.low), float(term.high)) for name, term in commands.items()}
    return {name: ends for name, ends in ranges.items() if math.isfinite(sum(ends)) and ends[0] < ends[1]}


def describe_model(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return `control_dt` [s] and `joints` of an environment that MuJoCo simulates; empty for any other."""
    simulation = find_mujoco(env)
    if simulation is None:
        return {}
    dt = getattr(env.unwrapped, "dt", None)  # not from the frame rate, which is rounded: 67 for a step of 0.015 s
    step = {"control_dt": float(dt)} if isinstance(dt, float | int) and dt > 0 else {}
    return {**step, "joints": describe_driven_joints(env, simulation[0])}


_PORT = "write `import gymnasium as gym`; reset returns (observation, info), and step five values"


def space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return a space as plain data; raises `UsageError` for a kind or size of space that policies do not support."""
    if isinstance(space, spaces.Box | spaces.MultiBinary) and (size := math.prod(space.shape or ())) > LARGEST_SPACE:
        raise UsageError(f"a space of {size:,} elements; at most {LARGEST_SPACE:,} are supported")
    if isinstance(space, spaces.Box):
        bounds = {"low": _encode_bounds(space.low), "high": _encode_bounds(space.high)}
        return {"type": "Box", **bounds, "shape": list(space.shape), "dtype": str(space.dtype)}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1:
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else list(space.n)}
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": {key: space_to_json(value) for key, value in space.spaces.items()}}
    if type(space).__module__.partition(".")[0] == "gym":
        raise OldGymError(f"the space {short_repr(space)} is of the old gym package, not of Gymnasium\n{_PORT}")
    kinds = "Box, Discrete, MultiDiscrete of one axis, MultiBinary, Dict"
    raise UsageError(f"the space {short_repr(space)} is not supported; {kinds} are")


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
    def read(text: str) -> float:
        return int(text) if text.lstrip("-").isdecimal() else float(text)

    if isinstance(value, str):
        return np.full(shape, read(value), dtype)
    return np.array([read(text) for text in value], dtype).reshape(shape)


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
