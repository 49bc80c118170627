"""Between SB3's models and the workers that play for them: a policy's numbers, and the statistics of normalisation.

A segment is played with the statistics of its beginning; they are brought up to date after it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from rlctl.train.pack import observation_statistics, pack
from rlctl.train.vec_env import PlayedSegment, WorkerVecEnv

Statistics = dict[str, tuple[NDArray[Any], NDArray[Any]]]
"""Mean and variance per normalised observation, "" for one that is not a dict."""


def acting_statistics(model: BaseAlgorithm) -> Statistics:
    """Return a copy of the statistics; until the first segment is over, as if observations were normalised already."""
    found = {}
    for key, rms in observation_statistics(model.get_vec_normalize_env()).items():
        mean, var = rms.mean.copy(), rms.var.copy()
        # Before that there are only the observations of a few resets, and what hardly varies in them would explode.
        found[key] = (mean, var) if model.num_timesteps else (np.zeros_like(mean), np.ones_like(var))
    return found


def send_policy(model: BaseAlgorithm, algo: str, env: WorkerVecEnv, statistics: Statistics) -> None:
    """Give the workers the present numbers of a model's policy."""
    info = env.policy_info = env.policy_info or pack(model, algo, env.workers.spec, env.workers.info)[0]
    tensors = {f"policy/{name}": value.cpu().numpy() for name, value in model.policy.state_dict().items()}
    for key, (mean, var) in statistics.items():
        tensors |= {f"normalize/{key}/mean": mean, f"normalize/{key}/var": var}
    env.workers.set_policy(info, tensors)
    if (state := env.workers.recurrent_state) is not None:
        last: Any = model._last_lstm_states  # type: ignore[attr-defined]
        state[:, 0], state[:, 1] = (part.cpu().numpy().transpose(1, 0, 2) for part in last.pi)
        state[np.asarray(model._last_episode_starts)] = 0.0


def update_reward_statistics(model: BaseAlgorithm, segment: PlayedSegment) -> NDArray[np.float32]:
    """Take the returns of a segment into account, and return its rewards divided by their deviation."""
    normalizer = model.get_vec_normalize_env()
    rewards = segment.reward
    if normalizer is None or not normalizer.norm_reward:
        return rewards.astype(np.float32)
    returns, done = np.zeros_like(rewards), segment.done
    for step in range(rewards.shape[1]):
        normalizer.returns = normalizer.returns * normalizer.gamma + rewards[:, step]
        returns[:, step] = normalizer.returns
        normalizer.returns[done[:, step]] = 0.0
    normalizer.ret_rms.update(returns.ravel())
    return normalizer.normalize_reward(rewards).astype(np.float32)


def update_observation_statistics(model: BaseAlgorithm, segment: PlayedSegment) -> None:
    """Take the observations of a segment into account."""
    for key, rms in observation_statistics(model.get_vec_normalize_env()).items():
        rows = segment.observation[key][:, 1:]
        rms.update(rows.reshape(-1, *rows.shape[2:]))


def to_network_layout(rows: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Return observations as the network's `space` has them: images with their channels first."""
    shape = space.shape or ()
    return np.moveaxis(rows, -1, -3) if len(shape) == 3 and rows.shape[-3:] != shape else rows
