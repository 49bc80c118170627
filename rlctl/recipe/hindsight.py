"""Which environments and recipes hindsight experience replay fits, and what turns it on."""

from collections.abc import Iterable

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import is_image, split_space
from rlctl.environments.info import EnvInfo
from rlctl.recipe.recipe import IN_HINDSIGHT, ON_POLICY, Recipe

_KEYS = ("observation", "achieved_goal", "desired_goal")
_LEAST_REWARDS = 20  # with fewer rewards nothing is known about their kind
_MOST_VALUES = 2  # of a sparse reward: at the goal, and everywhere else


def find_problem(recipe: Recipe, env: EnvInfo) -> str | None:
    """Return why an environment or a recipe excludes hindsight replay, beginning with the key; None if it fits."""
    if problem := _find_missing(env):
        return problem
    if recipe.reward_weights or any(stage.reward_weights for stage in recipe.stages):
        return "her: compute_reward does not use the recipe's reward_weights; remove her or reward_weights"
    if recipe.algo not in ON_POLICY and recipe.algo_kwargs.get("n_steps", 1) != 1:
        return "algo_kwargs.n_steps: hindsight does not support n-step returns; remove her or n_steps"
    return None


def _find_missing(env: EnvInfo) -> str | None:
    parts = split_space(env.spaces()[0])
    missing = [f"{key} in its observation" for key in _KEYS if key not in parts]
    if not env.has_compute_reward:
        missing.append("compute_reward")
    if missing:
        return (
            f"her: this environment has no {', no '.join(missing)}; hindsight needs a Dict observation of "
            f"{', '.join(_KEYS)}, and compute_reward(achieved_goal, desired_goal, info)"
        )
    achieved, desired = parts["achieved_goal"], parts["desired_goal"]
    if achieved.shape != desired.shape or not isinstance(desired, spaces.Box) or is_image(desired):
        return (
            f"her: achieved_goal is {achieved}, desired_goal {desired}: hindsight replaces one by the other, so "
            "both must be a Box of the same shape, not an image"
        )
    return None


def suggest_hindsight(recipe: Recipe, env: EnvInfo) -> str | None:
    """Return the options of `rlctl train` that turn hindsight on; None if it is on already, or excluded.

    An algorithm without hindsight, such as PPO, is replaced by one for the same actions.
    """
    if recipe.her is not None or find_problem(recipe, env) is not None:
        return None
    other = "sac" if isinstance(env.spaces()[1], spaces.Box) else "dqn"
    return f"--algo {recipe.algo if recipe.algo in IN_HINDSIGHT else other} --set her={{}}"


def has_sparse_reward(episodes: Iterable[NDArray[np.float64]]) -> bool | None:
    """Return whether rewards of episodes, each of shape (T,), have at most two values; None for too few rewards."""
    rewards = np.concatenate([np.zeros(0), *episodes])
    return None if len(rewards) < _LEAST_REWARDS else len(np.unique(rewards)) <= _MOST_VALUES
