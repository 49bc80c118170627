"""From a recipe to an SB3 model."""

import inspect
import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from rich.filesize import decimal as format_bytes
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from rlctl.environments.dict_spaces import split_space
from rlctl.errors import RecipeError, RlctlError, UsageError, short_repr
from rlctl.play.workers import Workers
from rlctl.policy.file import ACTOR_CRITIC
from rlctl.policy.own_modules import import_named
from rlctl.policy.torch_policy import ACTIVATIONS, ALGORITHMS, policy_name
from rlctl.recipe.hyperparameters import LINEAR, split_schedule
from rlctl.recipe.recipe import ON_POLICY, NormalizeSettings, Recipe
from rlctl.storage.untrusted import measure_free_memory
from rlctl.task.mirror import ACTION, join_places
from rlctl.training.device import describe_device, find_fastest
from rlctl.training.off_policy import replay_arguments
from rlctl.training.own_networks import check_policy_class, write_graph
from rlctl.training.privileged import POLICIES, has_privileged_critic
from rlctl.training.rollouts import WorkerVecEnv
from rlctl.training.snapshot import pack
from rlctl.training.stack_layout import find_stacking
from rlctl.training.stacked_replay import store_once
from rlctl.training.updates.ppo import PpoUpdate

# The system provides a replay buffer's memory only when it is written, so one that is too large fails hours later.
_FLOAT32 = 4  # [bytes]
_USABLE_SHARE = 0.9  # of the free memory; the environments need memory too
_DELAYED_BY_US = frozenset({"sac", "tqc"})  # algorithms whose `policy_delay` Stable-Baselines3 does not have
_CONTINUOUS = frozenset(ACTOR_CRITIC)


def build_on_device(
    recipe: Recipe, env: WorkerVecEnv, requested: str, *, cuda_available: bool
) -> tuple[BaseAlgorithm, str | None]:
    """Build the model of a recipe on the device of `--device`, for `auto` on the faster one.

    Also returns a line about the choice; None if there is none. Raises `RecipeError` as `build_model`.
    """
    model = build_model(recipe, env, "cpu" if requested == "auto" else requested)
    shapes = [tuple(parameter.shape) for parameter in model.policy.parameters()]
    fastest, reason = find_fastest(shapes, cuda_available=cuda_available)
    if requested == "auto" and fastest != "cpu":
        model = build_model(recipe, env, fastest)
    return model, describe_device(requested, fastest, reason, cuda_available=cuda_available)


def build_model(recipe: Recipe, env: WorkerVecEnv, device: str) -> BaseAlgorithm:
    """Build the model of a recipe on vector environments; raises `RecipeError` if they do not fit together."""
    if device.startswith("cuda") and (torch.device(device).index or 0) >= (count := torch.cuda.device_count()):
        # SB3 would silently take the CPU.
        raise UsageError(f"--device {device}: torch sees {count} CUDA devices here; use cpu or auto")
    cls = ALGORITHMS[recipe.algo]
    kwargs = _algorithm_kwargs(recipe)
    if recipe.her is not None:
        kwargs = {**replay_arguments(recipe, recipe.her, env.workers.info), **kwargs}
    name = policy_name(recipe.algo, env.observation_space)
    if name not in cls.policy_aliases:
        kind = "dictionaries" if isinstance(env.observation_space, spaces.Dict) else "images"
        raise RecipeError(f"{recipe.algo} cannot be used here: it has no network for {kind}")
    check_spaces(recipe.algo, env.observation_space, env.action_space)
    _check_memory(recipe, env)
    keep_compiler_out()
    policy_kwargs = {**recipe.policy_kwargs, **import_named(recipe.policy_kwargs)}
    if isinstance(activation := policy_kwargs.get("activation_fn"), str):
        policy_kwargs["activation_fn"] = ACTIVATIONS[activation]
    own_policy = policy_kwargs.pop("policy_class", None)
    if env.workers.privileged_sizes:
        if own_policy is not None:
            raise RecipeError(
                "policy_kwargs.policy_class: a critic that sees more (privileged) has its own policy class"
            )
        own_policy, policy_kwargs["privileged"] = POLICIES[recipe.algo], dict(env.workers.privileged_sizes)
    base = next(iter(cls.policy_aliases.values()))
    if own_policy is not None and not issubclass(own_policy, base):
        raise RecipeError(f"policy_kwargs.policy_class: {own_policy.__name__} is not a subclass of {base.__name__}")
    try:
        model: BaseAlgorithm = cls(
            own_policy or name,
            wrap_normalize(env, recipe.normalize, kwargs.get("gamma", 0.99)),
            policy_kwargs=policy_kwargs,
            seed=recipe.seed,
            device=device,
            **kwargs,
        )
        if recipe.algo in _DELAYED_BY_US:
            model.policy_delay = recipe.algo_kwargs.get("policy_delay", 1)  # type: ignore[attr-defined]
        if isinstance(model, OffPolicyAlgorithm):
            start = env.workers.info.history_start if env.workers.info.observation_history else "first"
            store_once(model.replay_buffer, find_stacking(env.workers, model.observation_space), start)
        if recipe.mirror or recipe.mirror_loss:
            add_mirror(model, env.workers, images=recipe.mirror, loss=recipe.mirror_loss)
        write_graph(model, recipe.algo, env.workers.info.spaces()[0])  # reports faults of a user's network
        if own_policy is not None and not has_privileged_critic(model.policy):
            use_sde = {"use_sde": True} if getattr(model, "use_sde", False) else {}
            model.policy.own_arguments = model.policy_kwargs | use_sde  # type: ignore[assignment]
            check_policy_class(model, recipe.algo, pack(model, recipe.algo, env.workers.spec, env.workers.info))
        return model
    except RlctlError:
        raise
    except Exception as error:
        own = import_named(recipe.policy_kwargs)
        if not own and not isinstance(error, AssertionError | ValueError | TypeError | RuntimeError):
            raise
        raise RecipeError(f"{recipe.algo} cannot be used here: {short_repr(str(error) or error, 300)}") from error


def add_mirror(model: Any, workers: Workers, *, images: bool, loss: float) -> None:
    """Let a PPO model learn from mirror images too, or with a mirror loss; raises `RecipeError` where it cannot."""
    task, info, key = workers.spec.task, workers.info, "mirror" if images else "mirror_loss"
    if not workers.mirror:
        raise RecipeError(f"{key}: {task} declares no mirror symmetry; leave the key out")
    if workers.spec.frame_stack > 1 or workers.spec.time_feature:
        raise RecipeError(f"{key}: observations with frame_stack or time_feature cannot be mirrored; leave them out")
    if not PpoUpdate.supports(model):
        raise RecipeError(f"{key}: supported only for PPO with multi-layer perceptrons with tanh or ReLU on the CPU")
    frames = {name: info.observation_history.get(name, 1) for name in info.observation_sizes}
    newest = [
        (name, size // frames[name]) for name, size in info.observation_sizes.items() for _ in range(frames[name])
    ]
    action = [(ACTION, len(workers.mirror[ACTION]))]
    observed = [*newest, *workers.privileged_sizes.items()]
    model.mirror = join_places(workers.mirror, observed), join_places(workers.mirror, action)
    model.mirror_images, model.mirror_loss = images, loss


def keep_compiler_out() -> None:
    """Remove torch's compiler decorators from the optimisers: they import the compiler (1.6 s), which is not used."""
    for name in ("add_param_group", "load_state_dict", "state_dict", "zero_grad"):
        setattr(torch.optim.Optimizer, name, inspect.unwrap(getattr(torch.optim.Optimizer, name)))
    for optimizer in (torch.optim.Adam, torch.optim.RMSprop):
        setattr(optimizer, "step", torch.no_grad()(inspect.unwrap(optimizer.step)))  # noqa: B010


def check_spaces(algo: str, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Raise `RecipeError` for spaces that SB3 refuses with an unclear message, or only during training."""
    needed: type[spaces.Space[Any]] = spaces.Box if algo in _CONTINUOUS else spaces.Space
    if algo == "dqn":
        needed = spaces.Discrete
    if not isinstance(action_space, needed):
        others = {spaces.Box: "ppo or sac", spaces.Discrete: "ppo or dqn"}.get(type(action_space), "ppo")
        kind, actions = needed.__name__, short_repr(action_space)
        raise RecipeError(f"{algo} cannot be used here: it needs {kind} actions, these are {actions}; try {others}")
    for what, space, advice in (
        ("observation", observation_space, "observe values less start"),
        ("action", action_space, "add start in step"),
    ):
        if isinstance(space, spaces.Box) and 0 in space.shape:
            raise RecipeError(f"the {what} is {space}, which has no element")
        for key, part in split_space(space).items():
            name = f"{what} {key!r}" if key else f"the {what}"
            if np.any(getattr(part, "start", 0)):
                raise RecipeError(
                    f"{name} is {part}, and Stable-Baselines3 counts categories from 0: "
                    f"leave start out of the space, and {advice}"
                )
            if isinstance(part, spaces.Box) and part.shape == () and what == "observation":
                raise RecipeError(f"{name} is {part}, a single number: make it an array of the shape (1,)")


def _algorithm_kwargs(recipe: Recipe) -> dict[str, Any]:
    ours = {"action_noise", "actor_average", *(("policy_delay",) if recipe.algo in _DELAYED_BY_US else ())}
    return {name: _make_schedule(value) for name, value in recipe.algo_kwargs.items() if name not in ours}


def _make_schedule(value: Any) -> Any:
    """Return a schedule that falls linearly to zero for rl-zoo's `lin_3e-4`; other values unchanged."""
    if not isinstance(value, str) or not value.startswith(LINEAR):
        return value
    start, _ = split_schedule(value)
    # The last rollout may pass the end, where the rate would be negative.
    return lambda remaining: max(remaining, 0.0) * start


def wrap_normalize(env: VecEnv, settings: NormalizeSettings | None, gamma: float) -> VecEnv:
    """Wrap environments in SB3's VecNormalize; only observations of real numbers are normalised."""
    if settings is None:
        return env
    keys = [key for key, box in split_space(env.observation_space).items() if _is_real(box)]
    observation = settings.observation and bool(keys)
    if not observation and not settings.reward:
        return env
    return VecNormalize(
        env,
        norm_obs=observation,
        norm_reward=settings.reward,
        clip_obs=settings.clip_observation,
        clip_reward=settings.clip_reward,
        gamma=gamma,
        norm_obs_keys=keys if observation and isinstance(env.observation_space, spaces.Dict) else None,
    )


def _is_real(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating) and not is_image_space(space)


def _check_memory(recipe: Recipe, env: WorkerVecEnv) -> None:
    parts = [(math.prod(part.shape or ()), part.dtype) for part in split_space(env.observation_space).values()]
    action = math.prod(env.action_space.shape or ()) * _FLOAT32
    if recipe.algo in ON_POLICY:
        key, rows = "n_steps", int(recipe.algo_kwargs.get("n_steps", 5)) * env.num_envs
        row = sum(elements for elements, _ in parts) * _FLOAT32 + action + 6 * _FLOAT32
    else:  # observations before and after, in the space's dtype, action, reward and two flags
        key, rows = "buffer_size", int(recipe.algo_kwargs["buffer_size"])
        if (layout := find_stacking(env.workers, env.observation_space)) is not None:
            parts = [(layout.size, env.observation_space.dtype)]
        observation = sum(elements * np.dtype(dtype or np.float32).itemsize for elements, dtype in parts)
        row = 2 * observation + action + 3 * _FLOAT32
    free = measure_free_memory()
    if free is not None and rows * row > _USABLE_SHARE * free:
        needs, are, given = format_bytes(rows * row), format_bytes(free), recipe.algo_kwargs.get(key)
        raise RecipeError(f"algo_kwargs.{key}: {given} needs {needs} of memory, but only {are} are free; reduce it")
