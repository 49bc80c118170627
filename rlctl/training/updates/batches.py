"""Minibatches of a replay buffer as NumPy arrays, for several updates at once."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from rlctl.environments.dict_spaces import join, map_parts, split
from rlctl.policy.layers import standardize
from rlctl.training.snapshot import observation_statistics
from rlctl.training.stacked_replay import StackedRows
from rlctl.training.updates.perceptrons import Floats

_Take = Callable[[Any, NDArray[Any]], NDArray[Any]]


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
    if type(buffer) not in (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer) or buffer.optimize_memory_usage:
        return _join_samples([buffer.sample(size, env=env) for _ in range(count)], model.gamma)
    stored = buffer.buffer_size if buffer.full else buffer.pos
    # SB3's generator, in SB3's order: checkpoints hold its state.
    drawn = [
        (np.random.randint(0, stored, size), np.random.randint(0, buffer.n_envs, size))  # noqa: NPY002
        for _ in range(count)
    ]
    rows, envs = (np.concatenate(numbers) for numbers in zip(*drawn, strict=True))
    statistics = observation_statistics(env)

    def take(values: Any, rows: NDArray[Any]) -> NDArray[Any]:
        if isinstance(values, StackedRows):
            return values[rows, envs]
        return values.reshape(-1, *values.shape[2:]).take(rows * buffer.n_envs + envs, axis=0)

    def take_observations(observations: Any, rows: NDArray[Any]) -> Any:
        parts = {key: take(values, rows) for key, values in split(observations).items()}
        for key, rms in statistics.items():
            # In place and in single precision: SB3's copies in double precision take five times as long.
            standardize(parts[key], rms.mean, np.sqrt(rms.var + env.epsilon), -env.clip_obs, env.clip_obs)
        return join(parts)

    last, returns, discounts = _sum_rewards(model, rows, take)
    return {
        "observations": take_observations(buffer.observations, rows),
        "next_observations": take_observations(buffer.next_observations, last),
        "actions": take(buffer.actions, rows),
        "rewards": returns,
        "discounts": discounts,
    }


def _sum_rewards(model: Any, rows: NDArray[Any], take: _Take) -> tuple[NDArray[Any], Floats, Floats]:
    """Return the row of each sum's last reward, the sums of `n_steps` rewards, and the factors of the next values.

    `take` returns the stored values in the given rows.
    """
    buffer, env, gamma = model.replay_buffer, model._vec_normalize_env, model.gamma
    returns, discounts = np.zeros((2, len(rows), 1), np.float32)
    last, goes_on = rows, np.ones(len(rows), bool)
    for step in range(getattr(buffer, "n_steps", 1)):
        last = np.where(goes_on, (rows + step) % buffer.buffer_size, last)
        rewards = buffer._normalize_reward(take(buffer.rewards, last), env)
        returns[goes_on, 0] += gamma**step * rewards[goes_on]
        discounts[goes_on] = gamma ** (step + 1)
        # The newest step ends the sum too: what the buffer holds after it is older.
        goes_on &= (last != (buffer.pos - 1) % buffer.buffer_size) & ~take(buffer.dones, last).astype(bool)
    discounts[:, 0] *= 1 - take(buffer.dones, last) * (1 - take(buffer.timeouts, last))
    return last, returns, discounts


def _join_samples(samples: list[Any], gamma: float) -> dict[str, Any]:
    def join_all(name: str) -> Any:
        parts = [split(getattr(sample, name)) for sample in samples]
        return join({key: torch.cat([part[key] for part in parts]).numpy() for key in parts[0]})

    discounts = gamma if samples[0].discounts is None else join_all("discounts")
    return {
        **{name: join_all(name) for name in ("observations", "next_observations", "actions", "rewards")},
        "discounts": np.asarray((1 - join_all("dones")) * discounts, np.float32),
    }
