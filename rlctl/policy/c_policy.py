"""Policies exported as C, compiled and called through ctypes; `rlctl export --c` verifies its files with them."""

import ctypes
import math
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium import spaces

from rlctl.environments.dict_spaces import split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, UsageError
from rlctl.policy.actor import Array, Exploration, Rows, act_one_by_one
from rlctl.policy.file import PolicyInfo
from rlctl.policy.policy import FileActor
from rlctl.storage import untrusted


def observation_type(env: EnvInfo) -> np.dtype[Any]:
    """Return the type of the C function's observation: double if a part of the observation is float64, else float."""
    types = [part.dtype for part in split_space(env.spaces()[0]).values()]
    return np.dtype(np.float64 if np.float64 in types else np.float32)


def action_type(env: EnvInfo) -> np.dtype[Any]:
    """Return the type of the C function's action: the environment's, or int for discrete actions."""
    space = env.spaces()[1]
    return np.result_type(np.float32, space.dtype) if isinstance(space, spaces.Box) else np.dtype(np.intc)


class CActor(FileActor):
    """A policy in a shared library that `rlctl.exporting.c_source` has compiled. Deterministic."""

    def __init__(self, info: PolicyInfo, library: ctypes.CDLL, count: int = 1) -> None:
        """Load it for `count` environments, each with a state of its own."""
        self.info, self.library = info, library
        self._act = library.rlctl_act
        self._act.argtypes, self._act.restype = [ctypes.c_void_p] * 3, None
        library.rlctl_repeat.argtypes, library.rlctl_repeat.restype = [*[ctypes.c_void_p] * 3, ctypes.c_long], None
        library.rlctl_state_size.restype = ctypes.c_size_t
        observation_space, self._space = info.env.spaces()
        self._keys = list(split_space(observation_space))
        size = sum(math.prod(part.shape or ()) for part in split_space(observation_space).values())
        self._observation = np.zeros(size // info.spec.frame_stack, observation_type(info.env))
        self._action = np.zeros(math.prod(self._space.shape or ()), action_type(info.env))
        # The C struct of the state; its size is a multiple of four bytes.
        self._memory = np.zeros((count, library.rlctl_state_size() // 4), np.float32)
        self._pointers = [
            (self._observation.ctypes.data, memory.ctypes.data, self._action.ctypes.data) for memory in self._memory
        ]
        self._dtype = self._action.dtype if isinstance(self._space, spaces.Box) else np.dtype(np.int64)

    @classmethod
    def load(cls, path: Path, count: int = 1) -> Self:
        """Load a library with the JSON description next to it; raises `ArtifactError` if it does not load."""
        try:
            content = untrusted.read_bytes(path.with_suffix(".json"))
            info = untrusted.parse_model(content, PolicyInfo, path.with_suffix(".json"), "policy")
            return cls(info, ctypes.CDLL(str(path)), count)
        except OSError as error:
            raise ArtifactError(f"{path}: the compiled policy does not load: {error}") from None

    def explore(self, exploration: Exploration) -> None:
        """Raise `UsageError` for exploration: the file has only the deterministic action."""
        if exploration.stochastic:
            raise UsageError("an exported policy cannot sample: the C file has only its deterministic action")

    def begin(self, rows: Rows) -> None:
        """Forget the recurrent states and earlier frames."""
        self._memory[rows.index] = 0.0

    def act(self, observations: Any, rows: Rows) -> tuple[Array, Array]:
        """Return the deterministic actions; the C function acts on one row at a time."""
        return act_one_by_one(observations, rows, self._act_one)

    def _act_one(self, observation: Any, row: int, seed: int, step: int) -> Any:
        self._fill(observation)
        self._act(*self._pointers[row])
        return self._action.reshape(self._space.shape or ()).astype(self._dtype)

    def repeat(self, observation: Any, count: int) -> None:
        """Compute the action for one observation `count` times in a C loop, to measure its time."""
        self._fill(observation)
        self.library.rlctl_repeat(*self._pointers[0], count)

    def _fill(self, observation: Any) -> None:
        parts = split(observation)
        # The C function stacks frames itself: it gets only the newest, which is the last.
        self._observation[:] = np.concatenate([parts[key] for key in self._keys], axis=None)[-len(self._observation) :]
