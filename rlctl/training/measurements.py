"""The columns of `metrics.csv` and `evals.csv`, except steps, time and stage.

Actions, exploration, values and gradients are read from SB3's buffers and optimisers after an update. These depend on
steps only, so a resumed run measures the same. A value that does not exist is None.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import obs_as_tensor

from rlctl.environments.dict_spaces import join, split, split_names
from rlctl.environments.info import EnvInfo
from rlctl.evaluation.episode_statistics import mean_metrics, mean_return, mean_terms, success_rate
from rlctl.play.messages import EpisodeResult
from rlctl.training.rollouts import WorkerVecEnv

HISTOGRAMS = 20  # number of times per training that histograms are written; they take more time than numbers

_ROWS = 500  # maximum number of last steps per environment that are measured
_SAMPLES = 2000  # values in a histogram
_AT_LIMIT = 0.99  # an action counts as saturated from this fraction of half its range


_LOSSES = (
    "learning_rate", "loss", "policy_gradient_loss", "policy_loss", "value_loss", "mirror_loss", "entropy_loss",
    "approx_kl", "clip_fraction", "clip_range", "explained_variance", "std", "actor_loss", "critic_loss", "ent_coef",
    "ent_coef_loss", "n_updates",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class LastSteps:
    """The last steps of all environments; arrays of shape (n_envs, steps, ...) except `values`."""

    observation: Mapping[str, NDArray[Any]]  # not normalised
    action: NDArray[Any]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    values: NDArray[Any] | None  # the critic's values of the steps, in any order; None if they were not computed


def measure(model: BaseAlgorithm, env: WorkerVecEnv, last_row: int, total_timesteps: int) -> dict[str, float | None]:
    """Return columns for the environment steps since the last row; log them, and histograms at intervals."""
    steps = model.num_timesteps
    last = _read_last_steps(model, env, steps - last_row)
    row = summarize_steps(last, model.action_space, model.logger.name_to_value)
    row["gradient_norm"] = _gradient_norm(model)
    for name, value in row.items():
        if value is not None:
            model.logger.record(f"rollout/{name}", value)
    part = max(1, total_timesteps // HISTOGRAMS)
    if last is not None and steps // part > last_row // part:
        if last.values is None:
            last = dataclasses.replace(last, values=estimate_values(model, last))
        for name, values in collect_histograms(last, env.workers.info, env.workers.privileged_sizes).items():
            model.logger.record(name, values)
    return row


def _read_last_steps(model: BaseAlgorithm, env: WorkerVecEnv, steps: int) -> LastSteps | None:
    """Return at most the last `steps` steps, None before the first: the last segment, or from the replay buffer."""
    replay: Any = getattr(model, "replay_buffer", None)
    if replay is not None:
        return _read_replay_buffer(replay, max(1, steps // env.num_envs))
    if (segment := env.last_segment) is None:
        return None
    rollout: Any = model.rollout_buffer  # type: ignore[attr-defined]
    observation = {key: rows[:, :-1] for key, rows in segment.observation.items()}
    space, action, half = env.action_space, segment.action, _half_range(env.action_space)
    if isinstance(space, spaces.Box) and half is not None:
        action = (action - (space.high + space.low) / 2) / half  # scaled as in a replay buffer
    return LastSteps(observation, action, segment.terminated, segment.truncated, rollout.values.ravel())


def _read_replay_buffer(buffer: Any, steps: int) -> LastSteps | None:
    stored = buffer.buffer_size if buffer.full else buffer.pos
    rows = np.arange(buffer.pos - min(stored, steps, _ROWS), buffer.pos)
    if not len(rows):
        return None
    done, timeout = (np.asarray(values[rows], np.bool_).T for values in (buffer.dones, buffer.timeouts))
    observation = {key: values[rows].swapaxes(0, 1) for key, values in split(buffer.observations).items()}
    # SB3 stores continuous actions scaled to [-1, 1].
    return LastSteps(observation, buffer.actions[rows].swapaxes(0, 1), done & ~timeout, done & timeout, None)


def _half_range(space: spaces.Space[Any]) -> NDArray[Any] | None:
    """Return half the range of each element of an action; None for actions without limits, or discrete ones."""
    if not isinstance(space, spaces.Box) or not np.isfinite([space.low, space.high]).all():
        return None
    return np.maximum((space.high - space.low) / 2, 1e-12)


def summarize_steps(
    last: LastSteps | None, space: spaces.Space[Any], log: Mapping[str, Any]
) -> dict[str, float | None]:
    """Return measurements of steps with actions of a space; `log` holds the values that SB3 logged in the update."""
    row: dict[str, float | None] = dict.fromkeys(("terminated", "action_saturation", "action_change"))
    if last is not None:
        ended = last.terminated | last.truncated
        if ended.any():
            row["terminated"] = float(last.terminated.sum() / ended.sum())
        if isinstance(space, spaces.Box):
            actions = last.action.astype(np.float32)
            if _half_range(space) is not None:
                row["action_saturation"] = float((np.abs(actions) > _AT_LIMIT).mean())
            if not ended[:, :-1].all():  # the change from one action to the next of the same episode, in half ranges
                row["action_change"] = float(np.abs(np.diff(actions, axis=1))[~ended[:, :-1]].mean())
    row["exploration"] = _measure_exploration(space, log.get("train/entropy_loss"))
    if last is not None and last.values is not None:
        return row | {"value": float(last.values.mean())}
    loss = log.get("train/actor_loss")  # minus the critic's mean value, with SAC's entropy bonus
    return row | {"value": None if loss is None else -float(loss)}


def _measure_exploration(space: spaces.Space[Any], entropy_loss: Any) -> float | None:
    """Return how widely an on-policy algorithm explores, as a fraction of half the action range or of all choices.

    For a normal distribution it is the standard deviation that has the logged entropy; the one that SB3 logs for gSDE
    is that of a matrix.
    """
    if entropy_loss is None or not math.isfinite(entropy_loss):
        return None
    if isinstance(space, spaces.Discrete):
        return math.exp(-entropy_loss) / int(space.n)
    if (half := _half_range(space)) is None:
        return None
    per_element = -entropy_loss / half.size
    return math.exp(min(per_element - 0.5 * math.log(2 * math.pi * math.e), 50.0)) / float(np.exp(np.log(half).mean()))


def _gradient_norm(model: BaseAlgorithm) -> float | None:
    """Return the norm of the last minibatch's gradient after clipping.

    For an off-policy actor and critic it is the critic's root mean square over about 1,000 updates, from Adam's state:
    the actor's update also changes the critic's gradients of the last minibatch.
    """
    if (critic := getattr(model, "critic", None)) is not None:
        return recent_gradient_norm(critic.optimizer)
    gradients = [parameter.grad for parameter in model.policy.parameters() if parameter.grad is not None]
    return float(torch.nn.utils.get_total_norm(gradients)) if gradients else None


def recent_gradient_norm(optimizer: torch.optim.Optimizer) -> float | None:
    """Return the root mean square of the gradient's norm over about 1,000 updates, from Adam's state; else None."""
    squares = [
        state["exp_avg_sq"].sum().item() / (1 - group["betas"][1] ** float(state["step"]))
        for group in optimizer.param_groups
        for parameter in group["params"]
        if "exp_avg_sq" in (state := optimizer.state.get(parameter, {}))
    ]
    return math.sqrt(sum(squares)) if squares else None


def collect_histograms(
    last: LastSteps, info: EnvInfo, privileged: Mapping[str, int] | None = None
) -> dict[str, torch.Tensor]:
    """Return the samples of TensorBoard's histograms: actions, values, and observations by name.

    `privileged` has the sizes of those that only the critic sees.
    """
    rows = join({key: values.reshape(-1, *values.shape[2:]) for key, values in last.observation.items()})
    named = split_names(rows, {**info.observation_sizes, **(privileged or {})})
    samples = {name: values for name, values in named.items() if name and np.issubdtype(values.dtype, np.floating)}
    samples |= {"actions": last.action} | ({} if last.values is None else {"values": last.values})
    flat = {name: np.asarray(values, np.float32).ravel() for name, values in samples.items()}
    return {
        f"histograms/{name}": torch.from_numpy(values[:: max(1, len(values) // _SAMPLES)].copy())
        for name, values in flat.items()
    }


def estimate_values(model: BaseAlgorithm, last: LastSteps) -> NDArray[Any]:
    """Return an off-policy critic's values of a sample of steps: the mean of its networks and quantiles."""
    picked = slice(None, None, max(1, last.action[..., 0].size // _SAMPLES))
    rows = {key: values.reshape(-1, *values.shape[2:])[picked] for key, values in last.observation.items()}
    observation, normalizer = join(rows), model.get_vec_normalize_env()
    if normalizer is not None:
        observation = normalizer.normalize_obs(observation)
    tensors: Any = obs_as_tensor(observation, model.device)
    actions = torch.as_tensor(last.action.reshape(-1, *last.action.shape[2:])[picked], device=model.device)
    model.policy.set_training_mode(False)
    with torch.no_grad():
        if isinstance(model, DQN):
            values = model.q_net(tensors).gather(1, actions.long())
        else:
            estimates = model.critic(tensors, actions.float())  # type: ignore[attr-defined]
            values = estimates if isinstance(estimates, torch.Tensor) else torch.cat(estimates, dim=1)
    return values.flatten(1).mean(1).cpu().numpy()


def training_row(
    recent: Sequence[EpisodeResult], weights: Mapping[str, float], log: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the means of recent episodes, and what SB3 logged in the last update; `weights` name the reward terms."""
    means, metrics = mean_terms(recent), mean_metrics(recent)
    return {
        "acting": _mean(episode.acting for episode in recent),
        "return": mean_return(recent) if recent else None,
        "length": _mean(episode.length for episode in recent),
        "success": success_rate(recent) if recent else None,
        "distance": _mean(episode.final_distance for episode in recent),
        **{f"term/{name}": means.get(name) for name in weights},
        **{f"metric/{name}": metrics.get(name) for name, weight in weights.items() if weight == 0},
        **{name: log.get(f"train/{name}") for name in _LOSSES},
    }


def tensorboard_values(row: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of a metrics row by TensorBoard tag, without those that SB3 and `measure` log."""
    tags = {"return": "rollout/ep_rew_mean", "length": "rollout/ep_len_mean", "success": "rollout/success_rate"}
    tags |= {"distance": "rollout/final_distance", "stage": "curriculum/stage"}
    for column, tag in (("term/", "reward_terms/"), ("metric/", "metrics/")):
        tags |= {name: name.replace(column, tag, 1) for name in row if name.startswith(column)}
    return {tag: row[name] for name, tag in tags.items() if row.get(name) is not None}


def evaluation_row(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return the columns of an evaluation's episodes."""
    depths = [episode.deepest_contact for episode in results if episode.deepest_contact is not None]
    return {
        "episodes": len(results),
        "success": success_rate(results),
        "return": mean_return(results),
        "length": _mean(episode.length for episode in results),
        "distance": _mean(episode.final_distance for episode in results),
        "overlap": float(np.median(depths)) if depths else None,
        **{f"term/{name}": value for name, value in mean_terms(results).items()},
        **{f"metric/{name}": value for name, value in mean_metrics(results).items()},
    }


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
