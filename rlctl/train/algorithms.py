"""From a recipe to an SB3 model: names checked against SB3's own signatures."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from rlctl.errors import RecipeError, UsageError, did_you_mean, short_repr
from rlctl.run.hyperparameters import with_whole_numbers
from rlctl.run.recipe import Normalize, Recipe
from rlctl.run.torch_policy import ALGORITHMS, activation, policy_name
from rlctl.train import footprint
from rlctl.train.hindsight import replay_arguments
from rlctl.train.vec_env import WorkerVecEnv

# Set by rlctl itself, or not plain data.
_NOT_FOR_RECIPES = frozenset(
    {
        "self", "policy", "env", "seed", "device", "verbose", "tensorboard_log", "policy_kwargs", "_init_setup_model",
        "rollout_buffer_class", "rollout_buffer_kwargs", "replay_buffer_class", "replay_buffer_kwargs",
    }
)  # fmt: skip
_NOT_FOR_POLICIES = frozenset(
    {
        "self", "observation_space", "action_space", "lr_schedule", "optimizer_class", "optimizer_kwargs",
        "features_extractor_class", "use_sde", "normalize_images",
    }
)  # fmt: skip
_DETERMINISTIC_EXPLORERS = frozenset({"td3", "ddpg"})


def build_model(recipe: Recipe, env: WorkerVecEnv, device: str) -> BaseAlgorithm:
    """Build the model of a recipe on vector environments; raises `RecipeError` for what does not fit."""
    _check_device(device)
    cls = ALGORITHMS[recipe.algo]
    kwargs = _algorithm_kwargs(recipe, cls, env.action_space)
    if recipe.her is not None:
        kwargs = {**replay_arguments(recipe, recipe.her, env.workers.info), **kwargs}
    name = policy_name(recipe.algo, env.observation_space)
    if name not in cls.policy_aliases:
        kind = "dictionaries" if isinstance(env.observation_space, spaces.Dict) else "images"
        raise RecipeError(f"{recipe.algo} cannot be used here: it has no network for {kind}")
    policy_kwargs = _policy_kwargs(recipe, cls.policy_aliases[name])
    _check_rollout(recipe, env.num_envs)
    footprint.check(recipe, env.observation_space, env.action_space, env.num_envs)
    try:
        return cls(
            name,
            wrap_normalize(env, recipe.normalize, kwargs.get("gamma", 0.99)),
            policy_kwargs=policy_kwargs,
            seed=recipe.seed,
            device=device,
            **kwargs,
        )
    except (AssertionError, ValueError, TypeError, RuntimeError, MemoryError) as error:
        raise RecipeError(f"{recipe.algo} cannot be used here: {short_repr(str(error), 300)}") from error


def _check_device(device: str) -> None:
    # SB3 silently takes the CPU where there is no GPU.
    if device == "auto":
        return
    try:
        requested = torch.device(device)
    except RuntimeError:
        raise UsageError(f"--device {device!r}: no such device; give cpu, cuda, cuda:1, or auto") from None
    if requested.type == "cuda" and (requested.index or 0) >= torch.cuda.device_count():
        raise UsageError(
            f"--device {device}: torch sees {torch.cuda.device_count()} CUDA devices here; use cpu or auto"
        )


def _algorithm_kwargs(recipe: Recipe, cls: type[BaseAlgorithm], action_space: spaces.Space[Any]) -> dict[str, Any]:
    known = _names(cls.__init__, _NOT_FOR_RECIPES)
    kwargs: dict[str, Any] = {}
    for name, value in recipe.algo_kwargs.items():
        if name not in known:
            raise RecipeError(
                f"algo_kwargs.{name}: {recipe.algo} has no parameter {name!r}.{did_you_mean(name, known)} "
                f"It has: {', '.join(known)}."
            )
        kwargs[name] = _value(name, value)
    if recipe.algo in _DETERMINISTIC_EXPLORERS:
        # Their policies are deterministic: without noise they would not explore at all.
        kwargs.setdefault("action_noise", 0.1)
    if isinstance(sigma := kwargs.get("action_noise"), int | float) and action_space.shape is not None:
        size = int(np.prod(action_space.shape))
        kwargs["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, float(sigma)))
    return kwargs


def _value(name: str, value: Any) -> Any:
    if isinstance(value, str) and value.startswith("lin_"):
        return _linear(value)
    value = with_whole_numbers(name, value)
    return tuple(value) if isinstance(value, list) else value


def _linear(text: str) -> Callable[[float], float]:
    """A schedule that falls from a value to zero over the training, written `lin_3e-4` as rl-zoo does."""
    start = float(text.removeprefix("lin_"))
    # The last rollout may go past the end, and a negative rate would unlearn.
    return lambda remaining: max(remaining, 0.0) * start


def _policy_kwargs(recipe: Recipe, policy_class: Any) -> dict[str, Any]:
    known = _names(policy_class.__init__, _NOT_FOR_POLICIES)
    kwargs = {}
    for name, value in recipe.policy_kwargs.items():
        if name not in known:
            raise RecipeError(
                f"policy_kwargs.{name}: {policy_class.__name__} has no parameter {name!r}."
                f"{did_you_mean(name, known)} It has: {', '.join(known)}."
            )
        kwargs[name] = activation(value) if name == "activation_fn" else with_whole_numbers(name, value)
    return kwargs


def _names(function: Any, without: Iterable[str]) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in without]


def _check_rollout(recipe: Recipe, n_envs: int) -> None:
    kwargs: Mapping[str, Any] = recipe.algo_kwargs
    if recipe.algo == "ppo" and int(kwargs["n_steps"]) * n_envs < 2:
        raise RecipeError("algo_kwargs.n_steps: one environment needs at least 2 steps a rollout")


def wrap_normalize(env: VecEnv, settings: Normalize | None, gamma: float) -> VecEnv:
    """Wrap environments in SB3's VecNormalize, as far as their observations are real numbers."""
    if settings is None:
        return env
    space = env.observation_space
    keys = None
    if isinstance(space, spaces.Dict):
        keys = [key for key, each in space.spaces.items() if _is_real(each)]
    observation = settings.observation and (bool(keys) if keys is not None else _is_real(space))
    if not observation and not settings.reward:
        return env
    return VecNormalize(
        env,
        norm_obs=observation,
        norm_reward=settings.reward,
        clip_obs=settings.clip_observation,
        clip_reward=settings.clip_reward,
        gamma=gamma,
        norm_obs_keys=keys if observation else None,
    )


def _is_real(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating) and not is_image_space(space)
