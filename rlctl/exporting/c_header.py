"""The elements of a C policy's observation and action: names, units and bounds, for comments and for arrays."""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, split_space
from rlctl.exporting.c_layers import write_number
from rlctl.policy.c_policy import action_type, observation_type
from rlctl.policy.file import PolicyInfo

_NUMBERS = {"float32": "float", "float64": "double"}


@dataclasses.dataclass(frozen=True)
class Element:
    """A named part of the observation, or an element of the action."""

    name: str
    size: int
    unit: str = ""  # empty if unknown


class Layout:
    """The elements of the C function's observation and action; `name` is the prefix of all names in the header."""

    def __init__(self, name: str, info: PolicyInfo) -> None:
        self.name = name
        self.info = info
        space, self.action_space = info.env.spaces()
        self.frames = info.spec.frame_stack
        self.parts = split_space(space)
        self.sizes = {key: math.prod(part.shape or ()) for key, part in self.parts.items()}
        self.size = sum(self.sizes.values()) // self.frames
        self.type = _NUMBERS[observation_type(info).name]
        self.action_type = _NUMBERS.get(action_type(info).name, "int")
        self.action_size = math.prod(self.action_space.shape or ())
        self.observed = self._list_observed()
        self.actions = self._list_actions()

    def _list_observed(self) -> list[Element]:
        env = self.info.env
        sizes = env.observation_sizes
        if SINGLE not in self.parts:
            sizes = self.sizes
        if sum(sizes.values()) != self.size:
            sizes = {"observation": self.size}
        return [Element(name, size, env.observation_units.get(name, "")) for name, size in sizes.items()]

    def _list_actions(self) -> list[Element]:
        joints = self.info.env.joints
        if joints and len(joints.names) == self.action_size:
            return [Element(name, 1) for name in joints.names]
        return [Element(f"action[{index}]", 1) for index in range(self.action_size)]

    def describe_observation(self) -> list[str]:
        """Return a line per named part of the observation: its indices, name and unit."""
        lines, first = [], 0
        for part in self.observed:
            unit = f" [{part.unit}]" if part.unit else ""
            index = f"[{first}]" if part.size == 1 else f"[{first}..{first + part.size - 1}]"
            lines.append(f"  {index:<10} {part.name}{unit}")
            first += part.size
        return lines

    def describe_action(self) -> list[str]:
        """Return lines on the meaning of the action and its bounds."""
        meaning, space = self.info.env.action_meaning or "action of the environment", self.action_space
        if not isinstance(space, spaces.Box):
            return [f"  {meaning}: {' '.join(str(space).split())}, counted from 0"]
        bounds = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
        ranges = [f"from {low:.6g} to {high:.6g}" for low, high in bounds]
        if self.info.env.joints and self.actions[0].name == self.info.env.joints.names[0]:
            ranges = [f"{joint.name}, {limits}" for joint, limits in zip(self.actions, ranges, strict=True)]
        elif len(set(ranges)) == 1:
            return [f"  {meaning}; every element {ranges[0]}"]
        return [f"  {meaning}", *(f"  [{index}] {limits}" for index, limits in enumerate(ranges))]

    def list_arrays(self) -> list[tuple[str, str, str, list[str]]]:
        """Return the header's constant arrays: type, name, the macro of the length, and the values as C."""
        observation_low, observation_high = _find_bounds(self.parts.values(), self.size)
        action_low, action_high = _find_bounds([self.action_space], self.action_size)
        observation, action = self.type, self.action_type
        return [
            ("char *const", "observation_names", "OBSERVATION_PARTS", [_quote(part.name) for part in self.observed]),
            ("char *const", "observation_units", "OBSERVATION_PARTS", [_quote(part.unit) for part in self.observed]),
            ("int", "observation_sizes", "OBSERVATION_PARTS", [str(part.size) for part in self.observed]),
            (observation, "observation_low", "OBSERVATION_SIZE", _write_numbers(observation_low, observation)),
            (observation, "observation_high", "OBSERVATION_SIZE", _write_numbers(observation_high, observation)),
            ("char *const", "action_names", "ACTION_SIZE", [_quote(element.name) for element in self.actions]),
            (action, "action_low", "ACTION_SIZE", _write_numbers(action_low, action)),
            (action, "action_high", "ACTION_SIZE", _write_numbers(action_high, action)),
        ]


def _find_bounds(parts: Iterable[spaces.Space[Any]], size: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the lowest and highest value of the last `size` elements; with stacked frames, of the newest frame."""
    bounds = [_find_part_bounds(part) for part in parts]
    low, high = (np.concatenate([np.ravel(pair[side]) for pair in bounds])[-size:] for side in (0, 1))
    return low, high


def _find_part_bounds(space: spaces.Space[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.Discrete):
        return np.array(0), np.array(space.n - 1)
    highest = space.nvec - 1 if isinstance(space, spaces.MultiDiscrete) else np.ones(space.shape or (), int)
    return np.zeros_like(highest), highest


def _write_numbers(values: NDArray[Any], kind: str) -> list[str]:
    return [write_number(value, kind) for value in values]


def _quote(text: str) -> str:
    """Return a text in UTF-8 as a C string literal."""
    plain = {*range(32, 127)} - set(b'"\\?')  # two question marks start a trigraph
    return '"' + "".join(chr(byte) if byte in plain else f"\\{byte:03o}" for byte in text.encode()) + '"'
