"""Base class of rollouts: workers play with the model's policy, and the model learns from the segments.

The normalisation statistics are constant while a segment is played, and are updated after it.
"""

import abc
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.recipe.recipe import Recipe
from rlctl.rollout.shared_arrays import SegmentArrays
from rlctl.training.own_networks import write_graph
from rlctl.training.snapshot import observation_statistics, pack
from rlctl.training.status import Progress
from rlctl.training.updates import choose_learner
from rlctl.training.vec_env import WorkerVecEnv

Check = Callable[[], None]  # called several times a second while workers play; may raise to stop
Statistics = dict[str, tuple[NDArray[Any], NDArray[Any]]]
"""Mean and variance per normalised observation, "" for one that is not a dict."""


class Rollouts(abc.ABC):
    """Replaces the loop in SB3's `learn`, which would query the policy at every step."""

    overlap = False  # whether a segment is played while the model learns from earlier ones
    is_trained = False  # whether the policy begins trained; then it plays the steps before the first update, too

    def __init__(self, model: Any, env: WorkerVecEnv, recipe: Recipe, progress: Progress) -> None:
        self.model = model
        self.env = env
        self._algo = recipe.algo
        self._progress = progress
        self._learner = choose_learner(model)
        self._policy_info: PolicyInfo | None = None
        self.rehearse: Callable[[int], None] = lambda updates: None  # called after so many off-policy updates

    def begin(self, total_timesteps: int) -> None:
        """Prepare the model to learn up to a step; start the first episodes of a new training."""
        self.model._setup_learn(total_timesteps - self.model.num_timesteps, None, reset_num_timesteps=False)

    def advance(self, check: Check | None = None) -> None:
        """Play a segment and learn: from this segment, or with overlap from earlier ones."""
        self.model.policy.set_training_mode(False)
        self.start()
        if self.overlap:
            self.learn()
        self.finish(check)
        if not self.overlap:
            self.learn()

    @abc.abstractmethod
    def start(self) -> None:
        """Let the workers start to play with the current policy."""

    @abc.abstractmethod
    def finish(self, check: Check | None) -> None:
        """Wait for the segment, and store it in the model's buffer."""

    @abc.abstractmethod
    def learn(self) -> None:
        """Do the updates due for the stored segments."""

    def acting_statistics(self) -> Statistics:
        """Return a copy of the statistics; before the first segment has ended, mean 0 and variance 1."""
        statistics = observation_statistics(self.model.get_vec_normalize_env())
        if self.model.num_timesteps or self.is_trained:
            return {key: (rms.mean.copy(), rms.var.copy()) for key, rms in statistics.items()}
        # A few resets vary too little: dividing by their deviation would give huge values.
        return {key: (np.zeros_like(rms.mean), np.ones_like(rms.var)) for key, rms in statistics.items()}

    def send_policy(self, statistics: Statistics) -> None:
        """Send the current weights and statistics to the workers."""
        model, workers = self.model, self.env.workers
        if self._policy_info is None:
            self._policy_info = pack(model, self._algo, workers.spec, workers.info).info
        tensors = {f"policy/{name}": value.cpu().numpy() for name, value in model.policy.state_dict().items()}
        for key, (mean, var) in statistics.items():
            tensors |= {f"normalize/{key}/mean": mean, f"normalize/{key}/var": var}
        tensors |= write_graph(model, self._algo, workers.info.spaces()[0])
        workers.set_policy(PolicyFile(self._policy_info, tensors))
        if (state := workers.recurrent_state) is not None:
            last = model._last_lstm_states.pi
            state[:, 0], state[:, 1] = (part.cpu().numpy().transpose(1, 0, 2) for part in last)
            state[np.asarray(model._last_episode_starts)] = 0.0

    def update_reward_statistics(self, segment: SegmentArrays) -> NDArray[np.float32]:
        """Update the return statistics with a segment; return its rewards divided by the returns' deviation."""
        normalizer = self.model.get_vec_normalize_env()
        rewards = segment.reward
        if normalizer is None or not normalizer.norm_reward:
            return rewards.astype(np.float32)
        returns, done = np.zeros_like(rewards), segment.done
        for step in range(rewards.shape[1]):
            normalizer.returns = normalizer.returns * normalizer.gamma + rewards[:, step]
            returns[:, step] = normalizer.returns
            normalizer.returns[done[:, step]] = 0.0
        normalizer.ret_rms.update(returns.ravel())
        normalized: NDArray[np.float32] = normalizer.normalize_reward(rewards).astype(np.float32)
        return normalized

    def finish_segment(self, segment: SegmentArrays) -> None:
        """Update the observation statistics with a stored segment."""
        model = self.model
        for key, rms in observation_statistics(model.get_vec_normalize_env()).items():
            rows = segment.observation[key][:, 1:]
            rms.update(rows.reshape(-1, *rows.shape[2:]))
        model._last_episode_starts = segment.done[:, -1]
        model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)


def to_network_layout(rows: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Return observations in the layout of the network's `space`: images channels-first."""
    shape = space.shape or ()
    return np.moveaxis(rows, -1, -3) if len(shape) == 3 and rows.shape[-3:] != shape else rows
