"""Worker environments as a VecEnv of Stable-Baselines3, and the base class of rollouts, which play and learn with them.

The normalisation statistics are constant while a segment is played, and are updated after it.
"""

import abc
import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from rlctl.environments.dict_spaces import Observations, count_outside, join
from rlctl.errors import EpisodeFailed
from rlctl.play.messages import EpisodeResult, LevelRule, Play
from rlctl.play.seeds import Stream, episode_seed, first_length
from rlctl.play.shared_arrays import SegmentArrays
from rlctl.play.workers import Workers
from rlctl.policy.actor import Exploration
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.recipe.recipe import Recipe
from rlctl.task.mirror import Mirror
from rlctl.training.own_networks import write_graph
from rlctl.training.privileged import name_as_sb3, widen, widen_space
from rlctl.training.progress import Progress
from rlctl.training.snapshot import Tensors, observation_statistics, pack, select_actor
from rlctl.training.updates.choice import choose_update


class WorkerVecEnv(VecEnv):
    """Plays with `Workers` for SB3. Seeds follow from run seed, environment and episode number, not from SB3."""

    def __init__(self, workers: Workers, run_seed: int) -> None:
        self.workers = workers
        self.run_seed = run_seed
        self.episodes_started = [0] * workers.n_envs  # per environment the number of episodes that have begun
        self._actions: list[list[NDArray[Any]]] = []  # of the running episodes: by environment, in parts
        self._levels: NDArray[np.float64] = workers.arrays.level.copy()  # when the last segment had ended
        self._level_rule: LevelRule | None = None
        self.mixes_ages = False
        """Whether `reset` begins episodes of random lengths, so that environments are not all at the same step."""
        self._limits: NDArray[np.int64] = workers.arrays.limit.copy()
        self.outside, self.outside_message = 0, ""  # observations outside their space since it was set to 0
        self.ended: list[EpisodeResult] = []  # episodes that ended since the list was emptied
        self.last_segment: SegmentArrays | None = None  # of `finish`; the next segment overwrites its arrays
        self.waited_s = 0.0  # time spent waiting for the environments to play [s], since it was set to 0
        self.taught: Sequence[int] = ()  # environments in which the teacher acts in the next segments
        self._steps = 0
        self._is_playing = False  # whether a segment has been started and not finished
        observation_space, action_space = workers.info.spaces()
        privileged = sum(workers.privileged_sizes.values())
        super().__init__(workers.n_envs, widen_space(observation_space, privileged), action_space)

    def follow_success(self, rule: LevelRule | None) -> None:
        """Begin the next episode of each environment at the rule's first level; without a rule at that of the spec."""
        self._level_rule = rule
        self.levels = np.full(self.num_envs, self.workers.spec.level if rule is None else rule.start)

    @property
    def levels(self) -> NDArray[np.float64]:
        """How hard the running episode of each environment is, from 0 to 1, shape (n_envs,)."""
        return self._levels

    @levels.setter
    def levels(self, levels: NDArray[np.float64]) -> None:
        self._levels = levels.copy()
        self.workers.arrays.level[:] = levels

    @property
    def limits(self) -> NDArray[np.int64]:
        """Steps after which the running episode of each environment is truncated; 0: by the task; shape (n_envs,)."""
        return self._limits

    @limits.setter
    def limits(self, limits: NDArray[np.int64]) -> None:
        self._limits = limits.copy()
        self.workers.arrays.limit[:] = limits

    def _seed(self, env: int, episode: int) -> int:
        return episode_seed(self.run_seed, Stream.TRAIN, env, episode)

    def reset(self) -> Any:
        """Start the next episode of every environment; return the first observations, shape (n_envs, ...)."""
        longest = self.workers.info.max_steps if self.mixes_ages else None
        if longest is None:
            self.limits = np.zeros(self.num_envs, np.int64)
        else:
            numbers = enumerate(self.episodes_started)
            self.limits = np.array([first_length(self.run_seed, env, number, longest) for env, number in numbers])
        try:
            self.workers.reset({env: self._seed(env, number) for env, number in enumerate(self.episodes_started)})
        except EpisodeFailed as error:
            error.actions = []
            raise
        self.episodes_started = [number + 1 for number in self.episodes_started]
        self._actions = [[actions] for actions in self.workers.arrays.segment.action[:, :0]]
        return self.observations()

    def observations(self) -> Observations:
        """Return a copy of the current observations, with what only the critic sees, shape (n_envs, ...)."""
        return join(widen({key: rows.copy() for key, rows in self.workers.arrays.observation.items()}))

    def join_actions(self, env: int) -> NDArray[Any]:
        """Return the actions of an environment's running episode so far, shape (steps, ...)."""
        return np.concatenate(self._actions[env])

    def begin_episodes(self, episodes_started: Sequence[int], actions: Sequence[NDArray[Any]]) -> set[int]:
        """Restore running episodes by repeating their actions; return the environments whose episode ended early."""
        self.episodes_started = list(episodes_started)
        seeds = [self._seed(env, number - 1) for env, number in enumerate(episodes_started)]
        episodes = dict(enumerate(zip(seeds, actions, strict=True)))
        ended = self.workers.begin_episodes(episodes, doing="replaying episodes", may_fail=True)
        self._actions = [[actions_of_episode] for actions_of_episode in actions]
        return ended

    def start(self, steps: int, exploration: Exploration) -> None:
        """Begin to play `steps` steps of each environment."""
        self._steps, self._is_playing = steps, True
        self.workers.arrays.call_row[:] = -1
        running, next_episodes = dict.fromkeys(range(self.num_envs), -1), dict(enumerate(self.episodes_started))
        rule = self._level_rule
        self.workers.start_playing(
            Play(steps, running, next_episodes, self.run_seed, rule, exploration, taught=self.taught)
        )

    def finish(self, watch: Callable[[], None] | None = None) -> SegmentArrays:
        """Wait for the steps that `start` began; `watch` is called several times a second."""
        began = time.monotonic()
        try:
            ended = self.workers.finish_playing(watch=watch)
        except EpisodeFailed as error:
            error.actions = self._failed_actions(error)
            raise
        self._is_playing = False
        self._levels = self.workers.arrays.level.copy()
        self.waited_s += time.monotonic() - began
        segment, steps = self.workers.arrays.segment, self._steps
        last_rows = {episode.env: episode.row for episode in ended}  # where the last episode of the segment ended
        for episode in ended:
            self.episodes_started[episode.env] += 1
            self._actions[episode.env] = []
        for env, actions in enumerate(segment.action[:, :steps]):
            self._actions[env].append(actions[last_rows.get(env, -1) + 1 :].copy())
        self.ended += self._leave_out_short(ended)
        self._limits = self.workers.arrays.limit.copy()
        last = segment.first(steps, ended)
        last = dataclasses.replace(last, observation=widen(last.observation), final=widen(last.final))
        seen = {key: rows[:, 1:] for key, rows in last.observation.items()}
        count, message = count_outside(self.observation_space, seen)
        self.outside, self.outside_message = self.outside + count, self.outside_message or message
        self.last_segment = last
        return last

    def _leave_out_short(self, ended: Sequence[EpisodeResult]) -> Sequence[EpisodeResult]:
        """Leave out the first episode of each environment that was shortened: it says little about the policy.

        `ended` has the episodes of an environment in their order.
        """
        short = set(np.flatnonzero(self._limits).tolist())
        counted = []
        for episode in ended:
            if episode.env in short:
                short.remove(episode.env)
            else:
                counted.append(episode)
        return counted

    @property
    def steps_in_segment(self) -> int:
        """How many steps of the segment that is being played were begun so far, by all environments."""
        return int((self.workers.arrays.call_row + 1).sum()) if self._is_playing else 0

    def last_observations(self) -> dict[str, NDArray[Any]]:
        """Return the last observations, by key, of all segments that were finished, shape (n_envs, ...)."""
        arrays = self.workers.arrays
        observations = {key: array.copy() for key, array in arrays.observation.items()}
        if self._is_playing:
            begun = arrays.call_row >= 0  # row 0 was written before; those done have replaced the other
            for key, array in observations.items():
                array[begun] = arrays.segment.observation[key][begun, 0]
        return observations

    def _failed_actions(self, error: EpisodeFailed) -> NDArray[Any]:
        """Return the actions of a failed episode; the last is that of the failed step."""
        arrays = self.workers.arrays
        rows = int(arrays.call_row[error.env]) + 1
        if error.step <= rows:
            return arrays.segment.action[error.env, rows - error.step : rows].copy()
        return np.concatenate([self.join_actions(error.env), arrays.segment.action[error.env, :rows]])

    def step_async(self, actions: NDArray[Any]) -> None:
        """Raise `NotImplementedError`: workers play whole segments."""
        raise NotImplementedError("workers play whole segments, not single steps")

    def step_wait(self) -> Any:
        """Raise `NotImplementedError`: workers play whole segments."""
        raise NotImplementedError("workers play whole segments, not single steps")

    def close(self) -> None:
        """End the workers."""
        self.workers.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return `render_mode`, None per environment; raise `AttributeError` for other names."""
        if attr_name == "render_mode":
            return [None] * self.num_envs
        raise AttributeError(f"attributes of environments in workers cannot be read: {attr_name}")

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise `AttributeError`: attributes of environments in workers cannot be set."""
        raise AttributeError(f"attributes of environments in workers cannot be set: {attr_name}")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call `compute_reward`, which SB3's hindsight replay needs; raise `AttributeError` for any other method."""
        if method_name == "compute_reward":  # of SB3's hindsight replay; its infos are empty
            rewards = self.workers.compute_rewards(*method_args[:2])
            return [rewards for _ in self._get_indices(indices)]
        raise AttributeError(f"methods of environments in workers cannot be called: {method_name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False per environment: no wrapper is visible from outside the workers."""
        return [False for _ in self._get_indices(indices)]


SegmentWatch = Callable[[], None]  # called several times a second while workers play; may raise to stop
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
        self._updater = choose_update(model)
        self._policy_info: PolicyInfo | None = None
        self._mirror = Mirror(model.mirror[0]) if hasattr(model, "mirror") else None  # of observations
        self.rehearse: Callable[[int], None] = lambda updates: None  # called after so many off-policy updates

    def begin(self, total_timesteps: int) -> None:
        """Prepare the model to learn up to a step; start the first episodes of a new training."""
        # It resets the environments if `_last_obs` is None; a resume has set it, with the episodes that ran.
        self.model._setup_learn(total_timesteps - self.model.num_timesteps, None, reset_num_timesteps=False)

    def advance(self, watch: SegmentWatch | None = None) -> None:
        """Play a segment and learn: from this segment, or with overlap from earlier ones."""
        self.model.policy.set_training_mode(False)
        self.start()
        if self.overlap:
            self.learn()
        self.finish(watch)
        if not self.overlap:
            self.learn()

    def close(self) -> None:
        """End the learner's processes."""
        if self._updater is not self.model:
            self._updater.close()

    @abc.abstractmethod
    def start(self) -> None:
        """Let the workers start to play with the current policy."""

    @abc.abstractmethod
    def finish(self, watch: SegmentWatch | None) -> None:
        """Wait for the segment, and store it in the model's buffer."""

    @abc.abstractmethod
    def learn(self) -> None:
        """Do the updates due for the stored segments."""

    def list_averages(self) -> Tensors:
        """Return the policy's tensors that are averages over updates, by the names of policy files."""
        return {}

    def take(self) -> tuple[Tensors, Any]:
        """Return what a checkpoint needs beside the model: tensors and plain data."""
        return {}, None

    def restore(self, tensors: Tensors, plain: Any) -> None:  # noqa: B027 (most have nothing to restore)
        """Restore what `take` returned."""

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
        weights = {name_as_sb3(name): value for name, value in model.policy.state_dict().items()}
        tensors = {f"policy/{name}": value.cpu().numpy() for name, value in weights.items()}
        for key, moments in statistics.items():
            mean, var = (select_actor(part, model.policy) for part in moments)
            tensors |= {f"normalize/{key}/mean": mean, f"normalize/{key}/var": var}
        tensors |= write_graph(model, self._algo, workers.info.spaces()[0])
        workers.set_policy(PolicyFile(self._policy_info, tensors))
        if (state := workers.recurrent_state) is not None:
            state[:, 0], state[:, 1] = (part.cpu().numpy().transpose(1, 0, 2) for part in model._last_lstm_states.pi)
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
        return normalizer.normalize_reward(rewards).astype(np.float32)

    def finish_segment(self, segment: SegmentArrays) -> None:
        """Update the observation statistics with a stored segment."""
        model = self.model
        for key, rms in observation_statistics(model.get_vec_normalize_env()).items():
            rows = segment.observation[key][:, 1:]
            rows = rows.reshape(-1, *rows.shape[2:])
            # Symmetric statistics: normalised, the mirror image of an observation is the mirrored observation.
            rms.update(rows if self._mirror is None else np.concatenate([rows, self._mirror(rows)]))
        model._last_episode_starts = segment.done[:, -1]
        model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)


def to_network_layout(rows: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Return observations in the layout of the network's `space`: images channels-first."""
    shape = space.shape or ()
    return np.moveaxis(rows, -1, -3) if len(shape) == 3 and rows.shape[-3:] != shape else rows
