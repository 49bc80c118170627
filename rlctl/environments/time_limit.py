"""The time limit of an environment that is no task of rlctl."""

from __future__ import annotations

from typing import Any

from gymnasium import Wrapper
from gymnasium.wrappers import TimeLimit


def find_time_limit(env: Any) -> int | None:
    """Return after how many steps an environment's episodes are truncated, by a `TimeLimit` or its registration.

    None where neither says so; what an environment does by itself is not known.
    """
    spec = getattr(env, "spec", None)
    limits = [spec.max_episode_steps] if spec and spec.max_episode_steps else []
    while isinstance(env, Wrapper):
        if isinstance(env, TimeLimit):
            limits.append(env._max_episode_steps)  # Gymnasium offers no other way
        env = env.env
    return min(limits, default=None)
