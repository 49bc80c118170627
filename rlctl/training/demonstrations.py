"""`rlctl train --demos`: reads episodes, Minari and LeRobot datasets; behaviour cloning lets an actor learn from them.

Off-policy the actor learns from them in the first part of the training too. The library `imitation` is not used: its
newest release, 1.0.1, needs gymnasium 0.29 and Stable-Baselines3 2.2.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, join, split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.environments.registry import make_slug
from rlctl.errors import ArtifactError, UsageError, describe_exception, explain_missing_package
from rlctl.output import format_count
from rlctl.play.episode import load_episode
from rlctl.policy.file import list_actor_tensors
from rlctl.recipe.recipe import ON_POLICY
from rlctl.storage import files, lerobot
from rlctl.training.rollouts import Rollouts, to_network_layout
from rlctl.training.snapshot import observation_statistics
from rlctl.training.start import Start, describe_demonstrations

_STATE, _SUCCESS = "observation.state", "next.success"  # LeRobot's names
REHEARSAL_SHARE = 0.25
"""Share of an off-policy training in which the actor also learns from the demonstrations, fewer and fewer times."""
_UPDATES, _BATCH, _RATE = 3000, 256, 1e-3
_STD = 0.1  # exploration after cloning; the entropy of such noise is about SAC's target
_CONSTANT = 1e-8  # variance below which an observation counts as constant


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """The T steps of an episode."""

    name: str  # the file, or the dataset and the episode's number
    observations: dict[str, NDArray[Any]]
    """The observation before each action by key, shape (T, ...) each; the key is "" for one that is not a dict."""
    actions: NDArray[Any]  # shape (T, ...)
    success: bool | None  # None if it is unknown


def read_demonstrations(path: Path, task: str, env: EnvInfo) -> list[Demonstration]:
    """Read an episode (.npz), a folder of them, or the folder of a LeRobot or Minari dataset; leave out failures."""
    episodes = _read(path, task)
    useful = [episode for episode in episodes if episode.success is not False and len(episode.actions)]
    if not useful:
        raise ArtifactError(f"{path}: none of its episodes ({len(episodes)}) succeeded: nothing to clone")
    for episode in useful:
        _check(episode, env)
    return useful


def _check(episode: Demonstration, env: EnvInfo) -> None:
    observation_space, action_space = env.spaces()
    parts = {
        f"observation {key}".strip(): (episode.observations.get(key), part)
        for key, part in split_space(observation_space).items()
    }
    for name, (values, space) in {**parts, "action": (episode.actions, action_space)}.items():
        shape = None if values is None else values.shape[1:]
        if values is None or shape != (space.shape or ()):
            raise ArtifactError(
                f"{episode.name}: its {name} has the shape {shape}, the task's {space.shape}: from another task?"
            )
        if not np.isfinite(values).all():
            raise ArtifactError(f"{episode.name}: an {name} is not finite")
    actions = episode.actions
    if isinstance(action_space, spaces.Box):  # other formats have float32
        within = np.isclose(actions, np.clip(actions, action_space.low, action_space.high), atol=1e-5)
    else:
        within = np.array([action_space.contains(action) for action in actions.astype(np.int64)])
    if not within.all():
        step = int(within.reshape(len(actions), -1).all(1).argmin())
        raise ArtifactError(
            f"{episode.name}: action {actions[step]} of step {step + 1} is outside the action space {action_space}"
        )


def _read(path: Path, task: str) -> list[Demonstration]:
    if own := [path] if path.suffix == ".npz" else sorted(path.glob("*.npz")):
        return [_read_own(file, task) for file in own]
    if lerobot.is_lerobot_dataset(path):
        return _read_lerobot(path)
    minari_folder = path if (path / "metadata.json").is_file() else path / "data"
    if not (minari_folder / "metadata.json").is_file():
        kinds = "an episode (.npz), a folder of episodes, or the folder of a LeRobot or Minari dataset"
        raise ArtifactError(f"{path}: no demonstrations: give {kinds}")
    try:
        return _read_minari(minari_folder)
    except ImportError as error:
        raise UsageError(explain_missing_package(f"--demos {path}", error.name, "demos")) from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError) as error:
        raise ArtifactError(f"{path}: damaged, or not a dataset: {describe_exception(error)}") from None


def _read_own(file: Path, task: str) -> Demonstration:
    episode = load_episode(file)
    info = episode.info
    if make_slug(info.spec.task) != make_slug(task):
        raise ArtifactError(f"{file}: an episode of the task {info.spec.task}, not of {task}")
    observations = {key: rows[: len(episode.actions)] for key, rows in split(episode.observations).items()}
    return Demonstration(str(file), observations, episode.actions, False if info.failure else info.success)


def _read_minari(folder: Path) -> list[Demonstration]:
    if not {"observation_space", "action_space"} <= set(files.read_json(folder / "metadata.json")):
        # Minari would build the environment that the file names, and so import any module.
        raise ValueError("metadata.json has no observation_space and action_space")
    from minari import MinariDataset

    episodes = []
    for episode in MinariDataset(folder):
        observations = {key: rows[: len(episode.actions)] for key, rows in split(episode.observations).items()}
        success = (episode.infos or {}).get("success")
        success = None if success is None else bool(np.any(success))
        episodes.append(Demonstration(f"{folder}: episode {episode.id}", observations, episode.actions, success))
    return episodes


def _read_lerobot(folder: Path) -> list[Demonstration]:
    """Read the columns that are observations, actions and success; images and videos are left out."""
    features = lerobot.read_features(folder)
    observed = [
        name for name, feature in features.items() if name.startswith("observation.") and not feature.is_picture
    ]
    names = [*observed, "action", *({_SUCCESS} & set(features))]
    if "action" not in features:
        raise ArtifactError(f"{folder}: a dataset without `action`")
    rows = lerobot.read_rows(folder, [features[name] for name in names], f"--demos {folder}")
    numbers, starts = np.unique(rows[lerobot.EPISODE], return_index=True)
    parts = {name: np.split(rows[name], starts[1:]) for name in names}
    keys = {name: SINGLE if name == _STATE else name.removeprefix("observation.") for name in observed}
    return [
        Demonstration(
            f"{folder}: episode {number}",
            {key: parts[name][row] for name, key in keys.items()},
            parts["action"][row],
            bool(parts[_SUCCESS][row].any()) if _SUCCESS in parts else None,
        )
        for row, number in enumerate(numbers)
    ]


def clone(start: Start, rollouts: Rollouts, env: EnvInfo, show: Callable[[str], None]) -> None:
    """Clone the demonstrations of a new training, `show` the result, and set up their repetition where it is due.

    Raises `ArtifactError` if a resumed training needs demonstrations that have changed.
    """
    recipe, path = start.recipe, Path(str((start.demos or {})["path"]))
    rehearses = recipe.algo not in ON_POLICY and start.step < REHEARSAL_SHARE * recipe.total_timesteps
    if start.checkpoint is not None and not rehearses:
        return
    if start.run is not None and describe_demonstrations(path) != start.demos:
        raise ArtifactError(f"{path}: the demonstrations have changed since this training began; restore them")
    cloning = Cloning(read_demonstrations(path, start.task, env), rollouts.model, recipe.total_timesteps)
    if rehearses:
        rollouts.rehearse = cloning.rehearse
    if start.checkpoint is None:
        show(cloning.clone(recipe.algo))


class Cloning:
    """Demonstrations, and the model whose actor learns to act as they do."""

    def __init__(self, demonstrations: list[Demonstration], model: Any, total_timesteps: int) -> None:
        self._model = model
        self._total_timesteps = total_timesteps
        self._episodes = len(demonstrations)
        self._observations = {
            key: np.concatenate([episode.observations[key] for episode in demonstrations])
            for key in split_space(model.observation_space)
        }
        self._actions = np.concatenate([episode.actions for episode in demonstrations])

    def clone(self, algo: str) -> str:
        """Set the normalisation, the actor and its noise; return a message."""
        model = self._model
        for key, moments in observation_statistics(model.get_vec_normalize_env()).items():
            rows = self._observations[key]
            var = rows.var(0, dtype=np.float64)
            moments.mean[...], moments.var[...] = rows.mean(0), np.where(var < _CONSTANT, 1.0, var)
            moments.count = float(self._total_timesteps)  # the actor depends on them, so they must change slowly
        named = {f"policy/{name}": parameter for name, parameter in model.policy.named_parameters()}
        optimizer = torch.optim.Adam([named[name] for name in list_actor_tensors(algo, named)], _RATE)
        self._imitate(optimizer, _UPDATES, 1.0, torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, _UPDATES))
        model.policy.set_training_mode(False)
        with torch.no_grad():
            loss = float(self._compute_loss(slice(None)))
            set_noise(model)
        is_box = isinstance(model.action_space, spaces.Box)
        error = f"mean error {math.sqrt(loss):.3f}" if is_box else f"loss {loss:.3f}"
        return f"cloned {format_count(self._episodes, 'demonstration')} ({len(self._actions):,} steps, {error})"

    def rehearse(self, updates: int) -> None:
        """Learn from the demonstrations again after off-policy updates: the new critic would otherwise spoil the actor.

        The weight of the loss grows with the values, as in TD3+BC, https://arxiv.org/abs/2106.06860.
        """
        model = self._model
        share = 1.0 - model.num_timesteps / (REHEARSAL_SHARE * self._total_timesteps)
        if (count := round(updates * share)) > 0:
            with torch.no_grad():
                values = torch.cat([*model.critic(*self._to_tensors(slice(_BATCH)))])
            self._imitate(model.actor.optimizer, count, 10.0 * (1.0 + float(values.abs().mean())))

    def _imitate(self, optimizer: torch.optim.Optimizer, updates: int, weight: float, schedule: Any = None) -> None:
        model = self._model
        rng = np.random.default_rng([model.seed, model.num_timesteps])
        model.policy.set_training_mode(True)
        for _ in range(updates):
            optimizer.zero_grad(set_to_none=False)  # `training/updates` shares the memory of the gradients
            torch.autograd.backward(weight * self._compute_loss(rng.integers(len(self._actions), size=_BATCH)))
            optimizer.step()
            if schedule is not None:
                schedule.step()

    def _to_tensors(self, rows: Any) -> tuple[Any, torch.Tensor]:
        model, actions = self._model, self._actions[rows]
        observations = join({key: part[rows] for key, part in self._observations.items()})
        if (normalizer := model.get_vec_normalize_env()) is not None:
            observations = normalizer.normalize_obs(observations)
        parts, network_spaces = split(observations), split_space(model.observation_space)
        inputs = {
            key: torch.as_tensor(to_network_layout(parts[key], part), device=model.device)
            for key, part in network_spaces.items()
        }
        if isinstance(model.action_space, spaces.Box):
            actions = (model.policy.scale_action(actions) if model.policy.squash_output else actions).astype(np.float32)
        return join(inputs), torch.as_tensor(actions, device=model.device)

    def _compute_loss(self, rows: Any) -> torch.Tensor:
        """Return the mean squared error of actions, or the negative log-likelihood of discrete ones."""
        model, (observations, targets) = self._model, self._to_tensors(rows)
        if hasattr(model, "actor"):
            actor = model.actor
            chosen = actor(observations, deterministic=True) if hasattr(actor, "log_std") else actor(observations)
        else:
            distribution = model.policy.get_distribution(observations)
            if not isinstance(model.action_space, spaces.Box):
                log_likelihood: torch.Tensor = distribution.log_prob(targets).mean()
                return -log_likelihood
            chosen = distribution.mode()
        return torch.nn.functional.mse_loss(chosen, targets)


def set_noise(model: Any) -> None:
    """Give the actor a standard deviation of about `_STD` in the states of the last pass."""
    actor = getattr(model, "actor", model.policy)
    log_std = getattr(actor, "log_std", None)
    if isinstance(log_std, torch.nn.Linear):  # SAC without gSDE
        log_std.weight.zero_()
        log_std.bias.fill_(math.log(_STD))
    elif log_std is not None:
        log_std += math.log(_STD) - actor.action_dist.distribution.stddev.log().mean()
    if hasattr(model, "actor_target"):
        model.actor_target.load_state_dict(model.actor.state_dict())
