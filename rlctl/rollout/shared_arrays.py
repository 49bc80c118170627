"""Arrays that the main process and its workers see at once, in one anonymous file."""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.dict_spaces import split_space

Fields = dict[str, tuple[tuple[int, ...], np.dtype[Any]]]

_ALIGNMENT = 64  # [bytes], a cache line: two workers never write one


def observation_fields(space: spaces.Space[Any]) -> Fields:
    """Return shape and dtype per observation key; see `rlctl.dict_spaces`."""
    return {key: _leaf(part) for key, part in split_space(space).items()}


def _leaf(space: spaces.Space[Any]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    if space.shape is None or space.dtype is None:
        raise TypeError(f"{type(space).__name__} inside a Dict space is not supported")
    return space.shape, np.dtype(space.dtype)


class SharedArrays:
    """Named arrays over one memory map: per environment a row in each.

    The file has no name, so nothing is left behind whatever kills the processes.
    """

    def __init__(
        self,
        descriptor: int,
        n_envs: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        terms: int,
    ) -> None:
        observation = observation_fields(observation_space)
        layout: Fields = {
            "action": _leaf(action_space),
            "reward": ((), np.dtype(np.float64)),
            "terminated": ((), np.dtype(np.bool_)),
            "truncated": ((), np.dtype(np.bool_)),
            "next_seed": ((), np.dtype(np.int64)),
            "inside": ((2,), np.dtype(np.int64)),
            "terms": ((terms,), np.dtype(np.float64)),
            "record": ((), np.dtype(np.bool_)),
            "cast": ((3,), np.dtype(np.int64)),
        }
        for key, field in observation.items():
            layout[f"observation/{key}"] = field
            layout[f"final/{key}"] = field
        size = 0
        offsets = {}
        for name, (shape, dtype) in layout.items():
            offsets[name] = size
            bytes_needed = n_envs * int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
            size += -(-max(bytes_needed, 1) // _ALIGNMENT) * _ALIGNMENT
        os.ftruncate(descriptor, size)
        self._map = mmap.mmap(descriptor, size)
        arrays: dict[str, NDArray[Any]] = {
            name: np.ndarray((n_envs, *shape), dtype, buffer=self._map, offset=offsets[name])
            for name, (shape, dtype) in layout.items()
        }
        self.action = arrays["action"]
        self.reward = arrays["reward"]
        self.terminated = arrays["terminated"]
        self.truncated = arrays["truncated"]
        self.next_seed = arrays["next_seed"]
        """Seed of the episode to start when the present one ends; negative: do not start one."""
        self.inside = arrays["inside"]
        """Episode seed and step of the call an environment is in, shape (n_envs, 2): to name it when its worker dies
        or hangs. Step 0 is the reset; a negative step: in no call."""
        self.terms = arrays["terms"]
        """Raw reward terms of the last step, shape (n_envs, terms), where `record` is set."""
        self.record = arrays["record"]
        self.cast = arrays["cast"]
        """Observations of another dtype than their space's, shape (n_envs, 3): how many came, and of the last the
        character of its dtype and the number of its key."""
        self.observation = {key: arrays[f"observation/{key}"] for key in observation}
        self.final = {key: arrays[f"final/{key}"] for key in observation}
        """The observation an episode ended with, where one ended in the last step."""


def anonymous_file() -> int:
    """Return the descriptor of a new file without a name."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rlctl-workers")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
