"""An environment in a worker, and its running episode."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from rlctl.rollout import returned_values
from rlctl.rollout.messages import EpisodeResult
from rlctl.rollout.returned_values import InvalidReturn


class RunningEpisode:
    """One environment and its episode; checks all returned values except observations."""

    def __init__(self, env: Any, index: int, metrics: Sequence[str] = ()) -> None:
        self.env = env
        self.index = index  # number of the environment
        self._metrics = metrics  # reward terms of weight 0
        self.seed = -1
        self.step = 0  # steps begun in the episode
        self.acting_s, self.stepping_s = 0.0, 0.0
        """Time that the policy and the environment took in the episode's steps [s]."""
        self._discrete = isinstance(env.action_space, spaces.Discrete)
        self._return = 0.0
        self._sums: dict[str, float] = {}
        self._raw_sums = dict.fromkeys(metrics, 0.0)
        self._deepest_contact: float | None = None

    def start(self, seed: int) -> Any:
        """Begin the episode of a seed; return its first observation."""
        self.seed, self.step = seed, 0
        self._return, self._sums, self._deepest_contact = 0.0, {}, None
        self._raw_sums = dict.fromkeys(self._metrics, 0.0)
        self.acting_s, self.stepping_s = 0.0, 0.0
        observation, info = returned_values.check_tuple(self.env.reset(seed=seed), returned_values.RESET, "reset")
        returned_values.check_info(info)
        return observation

    def take_step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the environment; return its checked result."""
        result = self.env.step(int(action) if self._discrete else action.copy())
        if result.__class__ is not tuple or len(result) != 5:
            result = returned_values.check_tuple(result, returned_values.STEP, "step")
        observation, reward, terminated, truncated, info = result
        if reward.__class__ is not float:
            reward = returned_values.to_float(reward, "reward")
        if not math.isfinite(reward):
            raise InvalidReturn(f"reward is {reward}")
        if info.__class__ is not dict:
            returned_values.check_info(info)
        if terminated.__class__ is not bool or truncated.__class__ is not bool:
            terminated = returned_values.to_bool(terminated, "terminated")
            truncated = returned_values.to_bool(truncated, "truncated")
        self._count(reward, info)
        return observation, reward, terminated, truncated, info

    def _count(self, reward: float, info: dict[str, Any]) -> None:
        self._return += reward
        sums = self._sums
        try:
            for name, value in info.get("reward_terms", {}).items():
                sums[name] = sums.get(name, 0.0) + value
        except (TypeError, AttributeError):
            raise InvalidReturn(f"info['reward_terms'] is {info['reward_terms']!r}, not a dict of numbers") from None
        for name in self._metrics:
            self._raw_sums[name] += info["metrics"][name]

    def measure_contact(self) -> None:
        """Update the largest overlap of bodies in this episode."""
        self._deepest_contact = max(self._deepest_contact or 0.0, self.env.unwrapped.sim.deepest_contact)

    def summarize(self, info: dict[str, Any], row: int, report: dict[str, Any]) -> EpisodeResult:
        """Return the result of the episode from the `info` of its last step, which is in a row of a segment."""
        success = info.get("is_success")
        metrics = info.get("metrics")  # may be anything in a plain environment
        distance = (metrics if isinstance(metrics, dict) else info).get("distance")
        # "distance" may be anything in a plain environment.
        if not isinstance(distance, int | float | np.number) or not math.isfinite(distance):
            distance = None
        terms = {
            str(name): returned_values.to_float(value, f"reward term {name}") for name, value in self._sums.items()
        }
        return EpisodeResult(
            self.index,
            self.seed,
            self._return,
            self.step,
            None if success is None else returned_values.to_bool(success, "info['is_success']"),
            terms,
            None if distance is None else float(distance),
            row,
            report,
            self._deepest_contact,
            self.acting_s / max(self.acting_s + self.stepping_s, 1e-9),
            {name: float(total) / self.step for name, total in self._raw_sums.items()},
        )
