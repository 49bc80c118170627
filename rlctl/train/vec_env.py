"""The worker environments as Stable-Baselines3 wants them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from rlctl.rollout.seeds import EpisodeAddress, Stream
from rlctl.rollout.workers import EpisodeResult, Workers

_NOTHING: dict[str, Any] = {}


class WorkerVecEnv(VecEnv):
    """Steps `Workers` for SB3. Every episode's seed follows from its address; SB3's own seeding is not used."""

    def __init__(self, workers: Workers, run_seed: int, episodes_started: list[int] | None = None) -> None:
        self.workers = workers
        self.run_seed = run_seed
        self.episodes_started = episodes_started or [0] * workers.n_envs
        """Per environment, how many episodes have begun: the next one's number."""
        self.ended: list[EpisodeResult] = []
        """Episodes that ended since somebody last took them."""
        self.render_mode = None
        super().__init__(workers.n_envs, *workers.info.spaces())

    def _start_next(self, env: int) -> int:
        address = EpisodeAddress(self.run_seed, Stream.TRAIN, env, self.episodes_started[env])
        self.episodes_started[env] += 1
        return address.seed

    def reset(self) -> Any:
        self.workers.reset({env: self._start_next(env) for env in range(self.num_envs)})
        self._set_next_seeds(range(self.num_envs))
        return self.workers.observations()

    def _set_next_seeds(self, envs: Any) -> None:
        for env in envs:
            address = EpisodeAddress(self.run_seed, Stream.TRAIN, env, self.episodes_started[env])
            self.workers.arrays.next_seed[env] = address.seed

    def step_async(self, actions: NDArray[Any]) -> None:
        self.workers.arrays.action[:] = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        ended = self.workers.step()
        arrays = self.workers.arrays
        infos = [_NOTHING] * self.num_envs
        if ended:
            envs = [result.env for result in ended]
            final = self.workers.final_observations(envs)
            for place, result in enumerate(ended):
                env = result.env
                self.episodes_started[env] += 1
                infos[env] = self._end_info(result, _row(final, place))
            self._set_next_seeds(envs)
            self.ended += ended
        # float32, as SB3's own environments hand rewards over.
        rewards = arrays.reward.astype(np.float32)
        return self.workers.observations(), rewards, arrays.terminated | arrays.truncated, infos

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


def _row(observations: Any, place: int) -> Any:
    if isinstance(observations, dict):
        return {key: value[place] for key, value in observations.items()}
    return observations[place]
