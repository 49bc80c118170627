"""SAC, TQC, CrossQ, TD3, DDPG and DQN on chunks of steps that workers play while the model learns."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from rlctl.dict_spaces import join, split_space
from rlctl.run.acting import Exploration
from rlctl.train.segments import (
    acting_statistics,
    send_policy,
    to_network_layout,
    update_observation_statistics,
    update_reward_statistics,
)
from rlctl.train.vec_env import PlayedSegment, WorkerVecEnv

_LONGEST = 1000
"""Steps after which an episode without a time limit is stored in parts."""


class ChunkRollouts(OffPolicyAlgorithm):
    """Replaces SB3's loop of one step and some updates, in which learner and environments wait for each other.

    With `overlap` a chunk is played with the policy from before the updates that the chunk before it is due, while
    these are computed: it is one chunk older than without. The order follows from steps alone, so it repeats exactly.
    """

    algorithm_name = ""
    overlap = True
    action_noise_scale = 0.0
    policy_plays_warmup = False
    """Whether the steps before the first update are played by the policy, which is a trained one, and not at random."""
    steps_to_learn = 0
    """Environment steps that are in the replay buffer and that no update is done for yet."""

    def learn(self, total_timesteps: int, callback: Any = None, **options: Any) -> Any:  # type: ignore[override]
        """Train until `total_timesteps` more environment steps are done."""
        total, callback = self._setup_learn(total_timesteps, callback, reset_num_timesteps=False, tb_log_name="run")
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total:
            callback.on_rollout_start()
            self._start_chunk()
            if self.overlap:
                self._learn_from_chunk()
            self._finish_chunk(callback)
            if not self.overlap:
                self._learn_from_chunk()
        # With overlap the last chunk's updates stay due: a run made longer does them beside its next chunk, as one that
        # was that long from the beginning.
        callback.on_training_end()
        return self

    @property
    def _workers_env(self) -> WorkerVecEnv:
        env: Any = self.env
        found: WorkerVecEnv = env.unwrapped
        return found

    def _start_chunk(self) -> None:
        self.policy.set_training_mode(False)
        env = self._workers_env
        send_policy(self, self.algorithm_name, env, acting_statistics(self))
        frequency, unit = self.train_freq.frequency, self.train_freq.unit  # type: ignore[union-attr]
        self._episodes_left = frequency if unit == TrainFrequencyUnit.EPISODE else 0
        steps = env.workers.info.max_steps or _LONGEST if self._episodes_left else frequency
        env.start(steps, self._exploration(), until_end=bool(self._episodes_left))

    def _exploration(self) -> Exploration:
        plays = self.policy_plays_warmup or (self.use_sde and self.use_sde_at_warmup)
        return Exploration(
            stochastic=True,
            warmup=self.num_timesteps < self.learning_starts and not plays,
            epsilon=float(getattr(self, "exploration_rate", 0.0)),
            action_noise=self.action_noise_scale,
            sde_every=max(self.sde_sample_freq, 0) if self.use_sde else 0,
        )

    def _finish_chunk(self, callback: BaseCallback) -> None:
        env = self._workers_env
        while True:
            segment = env.finish(getattr(callback, "announce_stop", None))
            self._store(segment)
            callback.on_step()
            self._episodes_left -= len(segment.infos)
            if self._episodes_left <= 0:
                return
            steps = env.workers.info.max_steps or _LONGEST
            env.start(steps, self._exploration(), until_end=True)

    def _store(self, segment: PlayedSegment) -> None:
        """Put a chunk into the replay buffer, raw, and do what SB3 does after each step."""
        spaces = split_space(self.observation_space)
        observation = {key: to_network_layout(rows, spaces[key]) for key, rows in segment.observation.items()}
        final = {key: to_network_layout(rows, spaces[key]) for key, rows in segment.final.items()}
        done, timeouts = segment.done, segment.truncated & ~segment.terminated
        buffer: Any = self.replay_buffer
        for step in range(done.shape[1]):
            now = {key: rows[:, step] for key, rows in observation.items()}
            after = {key: rows[:, step + 1] for key, rows in observation.items()}
            if (ended := done[:, step]).any():
                after = {key: rows.copy() for key, rows in after.items()}
                for key, rows in after.items():
                    rows[ended] = final[key][ended, step]
            infos = [{"TimeLimit.truncated": bool(each)} for each in timeouts[:, step]]
            reward = segment.reward[:, step].astype(np.float32)
            buffer.add(join(now), join(after), segment.stored[:, step], reward, ended, infos)
            self.num_timesteps += len(reward)
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._on_step()
        self.steps_to_learn += done.size
        update_reward_statistics(self, segment)
        update_observation_statistics(self, segment)
        self._last_obs = segment.last_observation
        self._last_original_obs = segment.last_observation
        self._last_episode_starts = done[:, -1]
        self._log_episodes(segment)

    def _log_episodes(self, segment: PlayedSegment) -> None:
        for info in segment.infos:
            self._update_info_buffer([info], np.ones(1, np.bool_))
            self._episode_num += 1
            if self._episode_num % 4 == 0:  # as SB3 by default
                self.dump_logs()

    def _learn_from_chunk(self) -> None:
        """Do the updates that are due for the last chunk."""
        steps, self.steps_to_learn = self.steps_to_learn, 0
        if steps and self.num_timesteps > self.learning_starts:
            updates = self.gradient_steps if self.gradient_steps >= 0 else steps
            if updates > 0:
                self.train(batch_size=self.batch_size, gradient_steps=updates)
