"""Rewards for exchanged goals, computed by an environment in another process: for hindsight replay.

The request is both arrays as safetensors; the answer, numbers as JSON.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from rlctl.errors import TaskError, describe_exception, format_plugin_traceback


def encode_request(achieved: NDArray[Any], desired: NDArray[Any]) -> bytes:
    """Return the message that requests the rewards of goals; both of shape (n, *goal)."""
    goals = {"achieved": achieved, "desired": desired}
    # safetensors writes the memory as it lies, so that columns would be taken for rows.
    return save({name: np.ascontiguousarray(each) for name, each in goals.items()})


def compute_answer(env: Any, message: bytes) -> list[float]:
    """Return the n rewards of a request; raises `TaskError` for anything but n finite numbers."""
    goals = load(message)
    count = len(goals["achieved"])
    infos: list[dict[str, Any]] = [{} for _ in range(count)]
    try:
        rewards = np.asarray(env.unwrapped.compute_reward(goals["achieved"], goals["desired"], infos))
    except BaseException as error:  # a plugin may raise anything, SystemExit too
        raise TaskError(
            f"compute_reward raised {describe_exception(error)}", details=format_plugin_traceback(error)
        ) from error
    if rewards.dtype.kind not in "fiub":
        raise TaskError(f"compute_reward returned an array of {rewards.dtype}, not of numbers")
    if rewards.shape != (count,):
        raise TaskError(f"compute_reward returned shape {rewards.shape} for {count} goals at once, not ({count},)")
    if not np.isfinite(rewards).all():
        bad = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise TaskError(
            f"compute_reward is {rewards[bad]} for achieved {goals['achieved'][bad]}, desired {goals['desired'][bad]}"
        )
    result: list[float] = rewards.astype(np.float64).tolist()
    return result
