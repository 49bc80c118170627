"""Arrays that the main process shares with its workers, in one anonymous file."""

import dataclasses
import mmap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import split_space
from rlctl.environments.info import EnvInfo
from rlctl.play.messages import EpisodeResult
from rlctl.policy.file import PolicyFile
from rlctl.processes.child_process import grow_anonymous_file

ArrayLayout = Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]  # shape and dtype per name

CRITIC = "critic"
"""Key of what only the critic sees, beside the keys of the observation."""
_ALIGNMENT = 64  # [bytes], a cache line: two workers never write one
_ROWS = ("stored", "action", "label", "reward", "terminated", "truncated", "terms")
"""The arrays of a segment that have a row for each step."""


def observation_fields(space: spaces.Space[Any]) -> ArrayLayout:
    """Return shape and dtype per observation key; see `rlctl.environments.dict_spaces`."""
    return {key: _leaf(part) for key, part in split_space(space).items()}


def _leaf(space: spaces.Space[Any]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    if space.shape is None or space.dtype is None:
        raise TypeError(f"{type(space).__name__} inside a Dict space is not supported")
    return space.shape, np.dtype(space.dtype)


def map_arrays(descriptor: int, layout: ArrayLayout) -> dict[str, NDArray[Any]]:
    """Map named arrays to a file, which grows if needed; each array begins at its own cache line."""
    size = 0
    offsets = {}
    for name, (shape, dtype) in layout.items():
        offsets[name] = size
        bytes_needed = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        size += -(-max(bytes_needed, 1) // _ALIGNMENT) * _ALIGNMENT
    grow_anonymous_file(descriptor, size)
    memory = mmap.mmap(descriptor, size)
    return {
        name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name]) for name, (shape, dtype) in layout.items()
    }


class SharedArrays:
    """Per environment its episode, its observation, and `steps` rows of its last segment.

    The file has no name, so nothing is left behind if the processes are killed. Unused pages take no memory.
    """

    def __init__(self, descriptor: int, info: EnvInfo, n_envs: int, steps: int, privileged: int = 0) -> None:
        """Map the arrays; `privileged` is the number of values that only the critic sees, under the key `CRITIC`."""
        observation_space, action_space = info.spaces()
        observation, action = dict(observation_fields(observation_space)), _leaf(action_space)
        if privileged:
            observation[CRITIC] = (privileged,), np.dtype(np.float32)
        stored = np.dtype(np.float32 if isinstance(action_space, spaces.Box) else np.int64)
        of_segment: ArrayLayout = {
            "stored": ((max(1, int(np.prod(action[0]))),), stored),
            "action": action,
            "label": action,
            "reward": ((), np.dtype(np.float64)),
            "terminated": ((), np.dtype(np.bool_)),
            "truncated": ((), np.dtype(np.bool_)),
            "terms": ((len(info.reward_weights),), np.dtype(np.float64)),
            **{f"final/{key}": field for key, field in observation.items()},
        }
        # Segments come last, so that the other arrays do not move when segments get longer.
        arrays = map_arrays(
            descriptor,
            {"inside": ((n_envs, 3), np.dtype(np.int64)), "level": ((n_envs,), np.dtype(np.float64))}
            | {"limit": ((n_envs,), np.dtype(np.int64))}
            | {f"observation/{key}": ((n_envs, *shape), dtype) for key, (shape, dtype) in observation.items()}
            | {f"segment/{name}": ((n_envs, steps, *shape), dtype) for name, (shape, dtype) in of_segment.items()}
            | {f"segment/observation/{k}": ((n_envs, steps + 1, *shape), d) for k, (shape, d) in observation.items()},
        )
        self.inside = arrays["inside"]
        """Episode seed, step and row of the segment during a call of each environment, shape (n_envs, 3); errors name
        them if a worker dies or hangs. Step 0 is the reset; the step is negative outside of calls."""
        self.call_seed, self.call_step, self.call_row = self.inside.T  # its columns, which share memory with it
        self.level = arrays["level"]
        """How hard the episode of each environment is, or the next one that begins, from 0 to 1; shape (n_envs,)."""
        self.limit = arrays["limit"]
        """Steps after which the episode of each environment is truncated, if it is shorter than the task's time limit;
        else 0; shape (n_envs,)."""
        self.observation = {key: arrays[f"observation/{key}"] for key in observation}  # the current ones, by key
        self.segment = SegmentArrays(
            {key: arrays[f"segment/observation/{key}"] for key in observation},
            {key: arrays[f"segment/final/{key}"] for key in observation},
            **{name: arrays[f"segment/{name}"] for name in _ROWS},
            ended=(),
        )


@dataclasses.dataclass(frozen=True)
class SegmentArrays:
    """The last segment: arrays of shape (n_envs, steps, ...)."""

    observation: dict[str, NDArray[Any]]
    """The observation before each action, and the one after the last; shape (n_envs, steps + 1, ...)."""
    final: dict[str, NDArray[Any]]  # the last observation of an episode, in the row of its last step
    stored: NDArray[Any]  # actions of the policy before clipping, or scaled to [-1, 1]; shape (n_envs, steps, elements)
    action: NDArray[Any]  # actions that the environments received
    label: NDArray[Any]  # actions that the teacher would take, if there is one
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    terms: NDArray[np.float64]  # raw reward terms, shape (n_envs, steps, terms), if they are recorded
    ended: Sequence[EpisodeResult] = ()  # the episodes that ended; only in the result of `first`

    @property
    def done(self) -> NDArray[np.bool_]:
        """Where an episode ended."""
        return self.terminated | self.truncated

    def first(self, steps: int, ended: Sequence[EpisodeResult]) -> "SegmentArrays":
        """Return the first steps, with the episodes that `ended` in them; the arrays share memory."""
        return self._select(np.s_[:, :steps], np.s_[:, : steps + 1], ended)

    def of(self, env: int) -> "SegmentArrays":
        """Return the segment of one environment: arrays of shape (steps, ...) that share memory."""
        return self._select(env, env, ())

    def by_step(self, envs: slice) -> "SegmentArrays":
        """Return the segment of some environments: arrays of shape (steps, n_envs, ...) that share memory."""
        own = self._select(envs, envs, ())
        return SegmentArrays(
            {key: rows.swapaxes(0, 1) for key, rows in own.observation.items()},
            {key: rows.swapaxes(0, 1) for key, rows in own.final.items()},
            **{name: getattr(own, name).swapaxes(0, 1) for name in _ROWS},
        )

    def _select(self, index: Any, observed: Any, ended: Sequence[EpisodeResult]) -> "SegmentArrays":
        return SegmentArrays(
            {key: rows[observed] for key, rows in self.observation.items()},
            {key: rows[index] for key, rows in self.final.items()},
            **{name: getattr(self, name)[index] for name in _ROWS},
            ended=ended,
        )


class PolicyNumbers:
    """The parameters of the policy that workers have loaded, in shared memory."""

    def __init__(self, descriptor: int, n_envs: int) -> None:
        self._descriptor = descriptor
        self._n_envs = n_envs
        self.arrays: dict[str, NDArray[Any]] = {}  # by name; a recurrent policy has also `state`
        self._structure: tuple[Any, ...] = ()

    def forget(self) -> None:
        """Note that the workers use another policy."""
        self.arrays, self._structure = {}, ()

    def write(self, policy: PolicyFile) -> list[tuple[str, tuple[int, ...], str]]:
        """Write a policy's parameters; return name, shape and dtype of each if workers must load it, else nothing.

        They need not load new parameters of the same policy; its recurrent state is then kept.
        """
        info, numbers = policy.info, dict(policy.actor_only().tensors)
        if (hidden := numbers.get("policy/lstm_actor.weight_hh_l0")) is not None:
            layers = sum("weight_hh" in name for name in numbers)
            numbers["state"] = np.zeros((self._n_envs, 2, layers, hidden.shape[1]), np.float32)
        layout = [(name, values.shape, str(values.dtype)) for name, values in numbers.items()]
        structure = (info.algo, info.policy_kwargs, info.clip_observation, layout)
        is_new = structure != self._structure
        if is_new:
            self.arrays = map_arrays(self._descriptor, {name: (v.shape, v.dtype) for name, v in numbers.items()})
            self._structure = structure
        else:
            numbers.pop("state", None)
        for name, values in numbers.items():
            self.arrays[name][...] = values
        return layout if is_new else []
