"""What a training takes of memory: refused before it begins, and not by the system's killer hours later.

numpy reserves a replay buffer without touching it, so one of a terabyte is made at once, and fills up step by step.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.filesize import decimal as format_bytes
from stable_baselines3.common.vec_env import VecEnv

from rlctl.dict_spaces import split_space
from rlctl.errors import RecipeError
from rlctl.run import memory
from rlctl.run.recipe import ON_POLICY, Recipe

_FLOAT32 = 4  # [bytes]
_BYTES_PER_WEIGHT = 4 * _FLOAT32  # the weight, its gradient, and two moments of the optimiser
_LSTM_PARTS = 4  # hidden and cell state, of actor and critic
_USABLE_SHARE = 0.9  # of the memory that is free; the environments need some as well


def check(recipe: Recipe, env: VecEnv) -> None:
    """Raise `RecipeError`, with the bytes, for buffers or networks that do not fit into this machine's memory."""
    free = memory.available()
    for name, size in _sizes(recipe, env).items():
        if free is not None and size > _USABLE_SHARE * free:
            _, _, key = name.partition(".")
            given = recipe.algo_kwargs.get(key) if key else "this network"
            needs, are = format_bytes(size), format_bytes(free)
            raise RecipeError(f"{name}: {given} needs {needs} of memory, and {are} are free; give less")


def _sizes(recipe: Recipe, env: VecEnv) -> dict[str, int]:
    """Return the bytes that each of a recipe's keys asks for."""
    kwargs, network = recipe.algo_kwargs, recipe.policy_kwargs
    parts = [(math.prod(part.shape or ()), part.dtype) for part in split_space(env.observation_space).values()]
    observation = sum(elements for elements, _ in parts) * _FLOAT32
    action = math.prod(env.action_space.shape or ()) * _FLOAT32
    if recipe.algo in ON_POLICY:
        row = observation + action + 6 * _FLOAT32
        if recipe.algo == "recurrent_ppo":
            hidden = int(network.get("lstm_hidden_size", 256))
            row += _LSTM_PARTS * int(network.get("n_lstm_layers", 1)) * hidden * _FLOAT32
        buffers = {"algo_kwargs.n_steps": int(kwargs.get("n_steps", 5)) * env.num_envs * row}
    else:  # observations before and after, action, reward and two flags; the buffer has them in the space's dtype
        stored = sum(elements * np.dtype(dtype or np.float32).itemsize for elements, dtype in parts)
        buffers = {
            "algo_kwargs.buffer_size": int(kwargs["buffer_size"]) * (2 * stored + action + 3 * _FLOAT32),
            "algo_kwargs.batch_size": int(kwargs.get("batch_size", 1)) * (2 * observation + action + 3 * _FLOAT32),
        }
    return {**buffers, "policy_kwargs": _count_weights(network) * _BYTES_PER_WEIGHT}


def _count_weights(kwargs: Mapping[str, Any]) -> int:
    """Return how many weights lie between given layers; what depends on the spaces is not counted."""
    arch = kwargs.get("net_arch") or []
    parts = list(arch.values()) if isinstance(arch, Mapping) else [arch, arch]
    weights = sum(int(before) * int(after) for part in parts for before, after in itertools.pairwise(part))
    hidden = int(kwargs.get("lstm_hidden_size", 0))
    return weights + 2 * 4 * hidden * hidden * int(kwargs.get("n_lstm_layers", 1))
