"""Hindsight experience replay: the model also learns as if the state that an episode reached had been its goal.

M. Andrychowicz et al., Hindsight Experience Replay, 2017, https://arxiv.org/abs/1707.01495; SB3's buffer does it.
In a curriculum the current stage computes the rewards of exchanged goals, also for episodes of earlier stages.
"""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.her import HerReplayBuffer

from rlctl.environments.info import EnvInfo
from rlctl.errors import RecipeError
from rlctl.recipe.recipe import Hindsight, Recipe

_KEYS = ("observation", "achieved_goal", "desired_goal")
_LEARNING_STARTS = 100  # SB3's own default, of every algorithm


def replay_arguments(recipe: Recipe, her: Hindsight, env: EnvInfo) -> dict[str, Any]:
    """Return SB3's arguments for the replay buffer; raises `RecipeError` for what hindsight excludes."""
    _check_goals(env)
    if recipe.reward_weights or any(stage.reward_weights for stage in recipe.stages):
        raise RecipeError("her: compute_reward does not use the recipe's reward_weights; remove her or reward_weights")
    if recipe.algo_kwargs.get("n_steps", 1) != 1:
        raise RecipeError("algo_kwargs.n_steps: hindsight does not support n-step returns; remove her or n_steps")
    steps, size = (env.max_steps or 0) * recipe.n_envs, int(recipe.algo_kwargs["buffer_size"])
    if size < min(2 * steps, recipe.total_timesteps):
        raise RecipeError(_no_room(size, recipe.n_envs, f"{2 * steps} is enough"))
    return {
        "replay_buffer_class": HerReplayBuffer,
        "replay_buffer_kwargs": her.model_dump(),
        "learning_starts": max(_LEARNING_STARTS, steps),
    }


def _check_goals(env: EnvInfo) -> None:
    space = env.spaces()[0]
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    missing = [f"{key} in its observation" for key in _KEYS if key not in parts]
    if not env.has_compute_reward:
        missing.append("compute_reward")
    if missing:
        raise RecipeError(
            f"her: this environment has no {', no '.join(missing)}; hindsight needs a Dict observation of "
            f"{', '.join(_KEYS)}, and compute_reward(achieved_goal, desired_goal, info)"
        )
    achieved, desired = parts["achieved_goal"], parts["desired_goal"]
    if achieved.shape != desired.shape or not isinstance(desired, spaces.Box) or is_image_space(desired):
        raise RecipeError(
            f"her: achieved_goal is {achieved}, desired_goal {desired}: hindsight exchanges them, so both must "
            "be a Box of the same shape, not an image"
        )


def _no_room(size: int, n_envs: int, advice: str) -> str:
    return (
        f"algo_kwargs.buffer_size: {size} steps of {n_envs} environments cannot hold the two complete episodes of "
        f"each environment that hindsight needs; {advice}"
    )


def has_whole_episode(buffer: ReplayBuffer) -> bool:
    """Return whether a hindsight buffer holds a complete episode; raises `RecipeError` if it is too small for one."""
    if not isinstance(buffer, HerReplayBuffer) or (buffer.ep_length > 0).any():
        return True
    if buffer.full:
        advice = f"set it to twice the steps of an episode, times {buffer.n_envs}"
        raise RecipeError(_no_room(buffer.buffer_size * buffer.n_envs, buffer.n_envs, advice))
    return False
