"""Policies exported as C, compiled and called through ctypes; `rlctl export --c` verifies its files with them."""

import ctypes
import math
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.errors import ArtifactError, UsageError
from rlctl.policy.file import PolicyInfo
from rlctl.policy.policy import Policy
from rlctl.storage import untrusted

LIBRARY_SUFFIX = ".so"


def observation_type(env: EnvInfo) -> np.dtype[Any]:
    """Return the type of the C function's observation: double if a part of the observation is float64, else float."""
    types = [part.dtype for part in split_space(env.spaces()[0]).values()]
    return np.dtype(np.float64 if np.float64 in types else np.float32)


def action_type(env: EnvInfo) -> np.dtype[Any]:
    """Return the type of the C function's action: the environment's, or int for discrete actions."""
    space = env.spaces()[1]
    return np.result_type(np.float32, space.dtype) if isinstance(space, spaces.Box) else np.dtype(np.intc)


class CPolicy(Policy):
    """A policy in a shared library that `rlctl.exporting.c_source` has compiled. Deterministic."""

    def __init__(self, info: PolicyInfo, library: ctypes.CDLL) -> None:
        super().__init__(info)
        self.library = library
        self._act = library.rlctl_act
        self._act.argtypes, self._act.restype = [ctypes.c_void_p] * 3, None
        library.rlctl_repeat.argtypes, library.rlctl_repeat.restype = [*[ctypes.c_void_p] * 3, ctypes.c_long], None
        library.rlctl_state_size.restype = ctypes.c_size_t
        self._keys = list(split_space(self.observation_space))
        size = sum(math.prod(part.shape or ()) for part in split_space(self.observation_space).values())
        self._observation = np.zeros(size // info.spec.frame_stack, observation_type(info.env))
        self._action = np.zeros(math.prod(self.action_space.shape or ()), action_type(info.env))
        # The C struct of the state; its size is a multiple of four bytes.
        self._memory = np.zeros(library.rlctl_state_size() // 4, np.float32)
        self._pointers = tuple(array.ctypes.data for array in (self._observation, self._memory, self._action))
        self._dtype = self._action.dtype if isinstance(self.action_space, spaces.Box) else np.dtype(np.int64)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Load a library with the JSON description next to it; raises `ArtifactError` if it does not load."""
        try:
            content = untrusted.read_bytes(path.with_suffix(".json"))
            info = untrusted.parse_model(content, PolicyInfo, path.with_suffix(".json"), "policy")
            return cls(info, ctypes.CDLL(str(path)))
        except OSError as error:
            raise ArtifactError(f"{path}: the compiled policy does not load: {error}") from None

    def predict(self, observation: Any, *, deterministic: bool = True) -> NDArray[Any]:
        """Return the action for one observation; a recurrent state is kept until `reset`."""
        if not deterministic:
            raise UsageError("an exported policy cannot sample: the C file has only its deterministic action")
        self._fill(observation)
        self._act(*self._pointers)
        return self._action.reshape(self.action_space.shape or ()).astype(self._dtype)

    def reset(self) -> None:
        """Begin an episode: forget the recurrent state and earlier frames."""
        self._memory[:] = 0.0

    def repeat(self, observation: Any, count: int) -> None:
        """Compute the action for one observation `count` times in a C loop, to measure its time."""
        self._fill(observation)
        self.library.rlctl_repeat(*self._pointers, count)

    def _fill(self, observation: Any) -> None:
        parts = split(observation)
        # The C function stacks frames itself: it gets only the newest, which is the last.
        self._observation[:] = np.concatenate([parts[key] for key in self._keys], axis=None)[-len(self._observation) :]
