"""What a training takes of memory: refused before it begins, and not by the system's killer hours later.

numpy reserves a replay buffer without touching it, so one of a terabyte is made at once, and fills up step by step.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from rich.filesize import decimal as format_bytes

from rlctl.dict_spaces import split_space
from rlctl.errors import RecipeError
from rlctl.run import memory
from rlctl.run.hyperparameters import ON_POLICY
from rlctl.run.recipe import Recipe

_FLOAT32 = 4  # [bytes]
_BYTES_PER_WEIGHT = 4 * _FLOAT32  # the weight, its gradient, and two moments of the optimiser
_LSTM_PARTS = 4  # hidden and cell state, of actor and critic
_USABLE_SHARE = 0.9  # of the memory that is free; the environments need some as well


def check(recipe: Recipe, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], n_envs: int) -> None:
    """Raise `RecipeError`, with the bytes, for buffers or networks that do not fit into this machine's memory."""
    there = memory.available()
    if there is None:
        return
    on_policy = recipe.algo in ON_POLICY
    needs = {
        f"algo_kwargs.{'n_steps' if on_policy else 'buffer_size'}": (
            _rollout(recipe, observation_space, action_space, n_envs)
            if on_policy
            else _replay(recipe, observation_space, action_space)
        ),
        "algo_kwargs.batch_size": 0 if on_policy else _batch(recipe, observation_space, action_space),
        "policy_kwargs": _network(recipe.policy_kwargs),
    }
    for name, size in needs.items():
        if size > _USABLE_SHARE * there:
            raise RecipeError(
                f"{name}: {_value(recipe, name)} needs {format_bytes(size)} of memory, and "
                f"{format_bytes(there)} are free; give less"
            )


def _value(recipe: Recipe, name: str) -> str:
    _, _, key = name.partition(".")
    return "this network" if not key else f"{recipe.algo_kwargs.get(key)}"


def _replay(recipe: Recipe, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> int:
    """Return the bytes of a replay buffer: observations before and after, action, reward and two flags a row."""
    rows = int(recipe.algo_kwargs["buffer_size"])
    return rows * (2 * _stored(observation_space) + _actions(action_space) + 3 * _FLOAT32)


def _batch(recipe: Recipe, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> int:
    rows = int(recipe.algo_kwargs.get("batch_size", 1))
    return rows * (2 * _elements(observation_space) * _FLOAT32 + _actions(action_space) + 3 * _FLOAT32)


def _rollout(recipe: Recipe, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], n_envs: int) -> int:
    """Return the bytes of a rollout buffer: observation, action and six numbers a row, and the LSTM's states."""
    rows = int(recipe.algo_kwargs.get("n_steps", 5)) * n_envs
    size = _elements(observation_space) * _FLOAT32 + _actions(action_space) + 6 * _FLOAT32
    if recipe.algo == "recurrent_ppo":
        hidden = int(recipe.policy_kwargs.get("lstm_hidden_size", 256))
        size += _LSTM_PARTS * int(recipe.policy_kwargs.get("n_lstm_layers", 1)) * hidden * _FLOAT32
    return rows * size


def _network(kwargs: Mapping[str, Any]) -> int:
    """Return the bytes of what lies between given layers; what depends on the spaces is not counted."""
    arch = kwargs.get("net_arch") or []
    parts = list(arch.values()) if isinstance(arch, Mapping) else [arch, arch]
    weights = sum(int(before) * int(after) for part in parts for before, after in itertools.pairwise(part))
    hidden = int(kwargs.get("lstm_hidden_size", 0))
    weights += 2 * 4 * hidden * hidden * int(kwargs.get("n_lstm_layers", 1))
    return weights * _BYTES_PER_WEIGHT


def _elements(space: spaces.Space[Any]) -> int:
    return sum(math.prod(part.shape or ()) for part in split_space(space).values())


def _stored(space: spaces.Space[Any]) -> int:
    """Return the bytes of an observation in the dtype of its space, as replay buffers keep it."""
    parts = split_space(space).values()
    return sum(math.prod(part.shape or ()) * np.dtype(part.dtype or np.float32).itemsize for part in parts)


def _actions(space: spaces.Space[Any]) -> int:
    return math.prod(space.shape or ()) * _FLOAT32
