"""Minibatches of a replay buffer as NumPy arrays, for several updates at once."""

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer

from rlctl.environments.dict_spaces import join, map_parts, split
from rlctl.training.updates.mlp import Floats


@dataclasses.dataclass(frozen=True)
class Batch:
    """A minibatch, shape (batch, ...) each; `features` are the networks' inputs."""

    features: Floats
    next_features: Floats
    actions: NDArray[Any]
    rewards: Floats
    discounts: Floats  # factor of the next observation's value: 0 where the episode ended


def sample_batches(model: Any, network: Any, count: int, size: int) -> list[Batch]:
    """Return `count` minibatches of `size` transitions, as SB3 would draw them; `network` extracts the features."""
    parts = _gather(model, count, size)
    features, next_features = (_extract(network, parts[name]) for name in ("observations", "next_observations"))
    arrays = (features, next_features, parts["actions"], parts["rewards"], parts["discounts"])
    return [Batch(*(array[first : first + size] for array in arrays)) for first in range(0, count * size, size)]


def _extract(network: Any, observations: Any) -> Floats:
    tensors = map_parts(torch.as_tensor, observations)
    return network.extract_features(tensors, network.features_extractor).numpy()


def _gather(model: Any, count: int, size: int) -> dict[str, Any]:
    """Return the transitions of all minibatches, one after the other."""
    buffer, env = model.replay_buffer, model._vec_normalize_env
    if type(buffer) not in (ReplayBuffer, DictReplayBuffer) or buffer.optimize_memory_usage:
        return _join_samples([buffer.sample(size, env=env) for _ in range(count)], model.gamma)
    stored = buffer.buffer_size if buffer.full else buffer.pos
    # SB3's generator, in SB3's order: checkpoints hold its state.
    drawn = [
        (np.random.randint(0, stored, size), np.random.randint(0, buffer.n_envs, size))  # noqa: NPY002
        for _ in range(count)
    ]
    rows, envs = (np.concatenate(numbers) for numbers in zip(*drawn, strict=True))

    def normalize(observations: Any) -> Any:
        return buffer._normalize_obs(map_parts(lambda values: values[rows, envs], observations), env)

    dones = buffer.dones[rows, envs] * (1 - buffer.timeouts[rows, envs])
    return {
        "observations": normalize(buffer.observations),
        "next_observations": normalize(buffer.next_observations),
        "actions": buffer.actions[rows, envs],
        "rewards": np.asarray(buffer._normalize_reward(buffer.rewards[rows, envs, None], env), np.float32),
        "discounts": np.asarray((1 - dones[:, None]) * model.gamma, np.float32),
    }


def _join_samples(samples: list[Any], gamma: float) -> dict[str, Any]:
    def join_all(name: str) -> Any:
        parts = [split(getattr(sample, name)) for sample in samples]
        return join({key: torch.cat([part[key] for part in parts]).numpy() for key in parts[0]})

    discounts = gamma if samples[0].discounts is None else join_all("discounts")
    return {
        **{name: join_all(name) for name in ("observations", "next_observations", "actions", "rewards")},
        "discounts": np.asarray((1 - join_all("dones")) * discounts, np.float32),
    }
