"""A policy's numbers in memory that the workers share, which they act with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.rollout.shared_arrays import map_arrays
from rlctl.run.network import select_actor_tensors
from rlctl.run.policy import PolicyInfo


class PolicyNumbers:
    """The numbers of the policy that workers have loaded."""

    def __init__(self, descriptor: int, n_envs: int) -> None:
        self._descriptor = descriptor
        self._n_envs = n_envs
        self._arrays: dict[str, NDArray[Any]] = {}
        self._structure: tuple[Any, ...] = ()

    @property
    def state(self) -> NDArray[np.float32] | None:
        """Hidden and cell state of each environment's episode, shape (n_envs, 2, layers, hidden); None without."""
        return self._arrays.get("state")

    def forget(self) -> None:
        """The workers do not act with them any more."""
        self._arrays, self._structure = {}, ()

    def write(self, info: PolicyInfo, tensors: Mapping[str, NDArray[Any]]) -> list[tuple[str, list[int], str]]:
        """Write a policy's numbers; return name, shape and dtype of each if workers have to load it, else nothing.

        They do not for other numbers of the same policy; the state stays as it is then.
        """
        numbers = select_actor_tensors(info, tensors)
        if (hidden := numbers.get("policy/lstm_actor.weight_hh_l0")) is not None:
            layers = sum("weight_hh" in name for name in numbers)
            numbers["state"] = np.zeros((self._n_envs, 2, layers, hidden.shape[1]), np.float32)
        layout = [(name, list(values.shape), str(values.dtype)) for name, values in numbers.items()]
        structure = (info.algo, info.policy_kwargs, info.clip_observation, layout)
        is_new = structure != self._structure
        if is_new:
            self._arrays = map_arrays(self._descriptor, {name: (v.shape, v.dtype) for name, v in numbers.items()})
            self._structure = structure
        else:
            numbers.pop("state", None)
        for name, values in numbers.items():
            self._arrays[name][...] = values
        return layout if is_new else []
