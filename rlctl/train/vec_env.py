"""The worker environments as Stable-Baselines3 wants them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from rlctl.dict_spaces import take_row
from rlctl.rollout.history import ActionHistory
from rlctl.rollout.seeds import EpisodeAddress, Stream
from rlctl.rollout.workers import EpisodeResult, Workers
from rlctl.train.space_monitor import SpaceMonitor

_NOTHING: dict[str, Any] = {}


class WorkerVecEnv(VecEnv):
    """Steps `Workers` for SB3. Every episode's seed follows from its address; SB3's own seeding is not used."""

    def __init__(self, workers: Workers, run_seed: int) -> None:
        self.workers = workers
        self.run_seed = run_seed
        self.episodes_started = [0] * workers.n_envs
        """Per environment, how many episodes have begun: the next one's number."""
        self.history = ActionHistory(workers.n_envs)
        """What was done in the running episodes."""
        self.monitor = SpaceMonitor(workers.info.spaces()[0])
        self.ended: list[EpisodeResult] = []
        """Episodes that ended since the last `take_ended`."""
        self.render_mode = None
        super().__init__(workers.n_envs, *workers.info.spaces())

    def _seed(self, env: int, episode: int) -> int:
        return EpisodeAddress(self.run_seed, Stream.TRAIN, env, episode).seed

    def reset(self) -> Any:
        self.workers.reset({env: self._seed(env, number) for env, number in enumerate(self.episodes_started)})
        self.episodes_started = [number + 1 for number in self.episodes_started]
        self._begun(range(self.num_envs))
        return self.workers.observations()

    def _begun(self, envs: Iterable[int]) -> None:
        envs = list(envs)
        self.history.begin(envs)
        for env in envs:
            self.workers.arrays.next_seed[env] = self._seed(env, self.episodes_started[env])

    def replay_actions(self, episodes_started: Sequence[int], actions: Sequence[NDArray[Any]]) -> set[int]:
        """Put each environment into its running episode by replaying the actions.

        `actions` has shape (steps, ...) per environment. Return the environments whose episode ended on the way,
        which they would not if they were deterministic.
        """
        self.episodes_started = list(episodes_started)
        seeds = [self._seed(env, number - 1) for env, number in enumerate(episodes_started)]
        ended = self.workers.replay_actions(dict(enumerate(zip(seeds, actions, strict=True))))
        self.monitor.forget(self.workers.arrays)  # counted the first time
        self.history = ActionHistory.of_episodes(actions, self.workers.arrays.action)
        for env in range(self.num_envs):
            self.workers.arrays.next_seed[env] = self._seed(env, self.episodes_started[env])
        return ended

    def step_async(self, actions: NDArray[Any]) -> None:
        self.workers.arrays.action[:] = actions
        self.history.add(self.workers.arrays.action)

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        ended = self.workers.step()
        arrays = self.workers.arrays
        infos = [_NOTHING] * self.num_envs
        if ended:
            envs = [result.env for result in ended]
            final = self.workers.final_observations(envs)
            for index, result in enumerate(ended):
                env = result.env
                self.episodes_started[env] += 1
                infos[env] = self._end_info(result, take_row(final, index))
            self._begun(envs)
            self.ended += ended
        # float32, as SB3's own environments hand rewards over.
        rewards = arrays.reward.astype(np.float32)
        observations = self.workers.observations()
        self.monitor.look(observations)
        return observations, rewards, arrays.terminated | arrays.truncated, infos

    def _end_info(self, result: EpisodeResult, final_observation: Any) -> dict[str, Any]:
        arrays = self.workers.arrays
        info: dict[str, Any] = {
            "terminal_observation": final_observation,
            "TimeLimit.truncated": bool(arrays.truncated[result.env] and not arrays.terminated[result.env]),
            "episode": {"r": result.total_reward, "l": result.length, "t": 0.0},
        }
        if result.success is not None:
            info["is_success"] = result.success
        return info

    def take_ended(self) -> list[EpisodeResult]:
        """Return the episodes that ended since the last call."""
        ended, self.ended = self.ended, []
        return ended

    def close(self) -> None:
        self.workers.close()

    def seed(self, seed: int | None = None) -> list[int | None]:
        return [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        if attr_name == "render_mode":
            return [None for _ in self._get_indices(indices)]
        raise AttributeError(f"worker environments do not hand out attributes: {attr_name}")

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"worker environments take no attributes: {attr_name}")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        if method_name == "compute_reward":  # of SB3's hindsight replay; its infos are empty
            rewards = self.workers.compute_rewards(*method_args[:2])
            return [rewards for _ in self._get_indices(indices)]
        raise AttributeError(f"worker environments hand out no methods: {method_name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
