"""Arrays that the main process and its workers see at once, in one anonymous file."""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Mapping, Sequence
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


Layout = Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]
"""Shape and dtype per name."""


def map_arrays(descriptor: int, layout: Layout) -> dict[str, NDArray[Any]]:
    """Map named arrays over a file, which grows if it is too short; each begins at a cache line of its own."""
    size = 0
    offsets = {}
    for name, (shape, dtype) in layout.items():
        offsets[name] = size
        bytes_needed = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        size += -(-max(bytes_needed, 1) // _ALIGNMENT) * _ALIGNMENT
    if os.fstat(descriptor).st_size < size:
        os.ftruncate(descriptor, size)
    memory = mmap.mmap(descriptor, size)
    return {
        name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name]) for name, (shape, dtype) in layout.items()
    }


class SharedArrays:
    """Per environment a row in each array, and `steps` rows for the segment it plays last.

    The file has no name, so nothing is left behind whatever kills the processes. Pages that nobody writes to take no
    memory.
    """

    def __init__(
        self, descriptor: int, n_envs: int, spaces_: tuple[spaces.Space[Any], spaces.Space[Any]], terms: int, steps: int
    ) -> None:
        observation, action = observation_fields(spaces_[0]), _leaf(spaces_[1])
        stored = np.dtype(np.float32 if isinstance(spaces_[1], spaces.Box) else np.int64)
        now: Fields = {
            "action": action,
            "reward": ((), np.dtype(np.float64)),
            "terminated": ((), np.dtype(np.bool_)),
            "truncated": ((), np.dtype(np.bool_)),
            "next_seed": ((), np.dtype(np.int64)),
            "inside": ((3,), np.dtype(np.int64)),
            "terms": ((terms,), np.dtype(np.float64)),
            "record": ((), np.dtype(np.bool_)),
            "cast": ((3,), np.dtype(np.int64)),
            **{f"{kind}/{key}": field for key, field in observation.items() for kind in ("observation", "final")},
        }
        of_segment: Fields = {
            "stored": ((max(1, int(np.prod(action[0]))),), stored),
            **{name: now[name] for name in ("action", "reward", "terminated", "truncated", "terms")},
            **{f"final/{key}": field for key, field in observation.items()},
        }
        arrays = map_arrays(
            descriptor,
            {name: ((n_envs, *shape), dtype) for name, (shape, dtype) in now.items()}
            | {f"segment/{name}": ((n_envs, steps, *shape), dtype) for name, (shape, dtype) in of_segment.items()}
            | {f"segment/observation/{k}": ((n_envs, steps + 1, *shape), d) for k, (shape, d) in observation.items()},
        )
        self.action = arrays["action"]
        self.reward = arrays["reward"]
        self.terminated = arrays["terminated"]
        self.truncated = arrays["truncated"]
        self.next_seed = arrays["next_seed"]
        """Seed of the episode to start when the present one ends; negative: do not start one."""
        self.inside = arrays["inside"]
        """Episode seed, step and row of the segment of the call an environment is in, shape (n_envs, 3): to name it
        when its worker dies or hangs. Step 0 is the reset; a negative step: in no call."""
        self.terms = arrays["terms"]
        """Raw reward terms of the last step, shape (n_envs, terms), where `record` is set."""
        self.record = arrays["record"]
        self.cast = arrays["cast"]
        """Observations of another dtype than their space's, shape (n_envs, 3): how many came, and of the last the
        character of its dtype and the number of its key."""
        self.observation = {key: arrays[f"observation/{key}"] for key in observation}
        """What the next action is chosen from."""
        self.final = {key: arrays[f"final/{key}"] for key in observation}
        """The observation an episode ended with, where one ended in the last step."""
        self.segment = Segment(arrays, list(observation))


class Segment:
    """What was played last: arrays of shape (n_envs, steps, ...)."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], keys: Sequence[str]) -> None:
        self.observation = {key: arrays[f"segment/observation/{key}"] for key in keys}
        """What each action was chosen from, and what followed the last; shape (n_envs, steps + 1, ...)."""
        self.final = {key: arrays[f"segment/final/{key}"] for key in keys}
        """What an episode ended with, in the row of its last step."""
        self.stored = arrays["segment/stored"]
        """Actions as the policy chose them: not clipped, or scaled to [-1, 1]; shape (n_envs, steps, elements)."""
        self.action = arrays["segment/action"]
        """Actions as the environments took them."""
        self.reward = arrays["segment/reward"]
        self.terminated = arrays["segment/terminated"]
        self.truncated = arrays["segment/truncated"]
        self.terms = arrays["segment/terms"]

    @property
    def steps(self) -> int:
        """The most steps that a segment can have."""
        return int(self.reward.shape[1])


def anonymous_file() -> int:
    """Return the descriptor of a new file without a name."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rlctl-workers")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
