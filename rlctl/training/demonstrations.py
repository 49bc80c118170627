"""Demonstrations of `rlctl train --demos`: recorded episodes, Minari datasets and LeRobot datasets."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rlctl.environments.dict_spaces import SINGLE, split, split_space
from rlctl.environments.info import EnvInfo
from rlctl.environments.registry import make_slug
from rlctl.errors import ArtifactError, UsageError, describe_exception, explain_missing_package
from rlctl.run.episode import load_episode
from rlctl.storage import files

_SUFFIXES = (".npz", ".parquet", ".hdf5", ".arrow", ".json")
_STATE, _SUCCESS = "observation.state", "next.success"  # LeRobot's names


@dataclasses.dataclass(frozen=True)
class Demonstration:
    """The T steps of an episode."""

    name: str
    """The file, or the dataset and the episode's number."""
    observations: dict[str, NDArray[Any]]
    """The observation before each action by key, shape (T, ...) each; the key is "" for one that is not a dict."""
    actions: NDArray[Any]
    """Shape (T, ...)."""
    success: bool | None
    """None if it is unknown."""


def describe_source(path: Path) -> dict[str, str]:
    """Return the absolute path of demonstrations and a hash of their files, without videos."""
    found = [path] if path.is_file() else sorted(path.rglob("*"))
    parts = [files.digest(file.read_bytes()) for file in found if file.suffix in _SUFFIXES]
    return {"path": str(path.absolute()), "sha256": files.digest("".join(parts).encode())}


def read_demonstrations(path: Path, task: str, env: EnvInfo) -> list[Demonstration]:
    """Read an episode (.npz), a folder of them, or the folder of a LeRobot or Minari dataset; leave out failures.

    Raises `ArtifactError` for what is missing or damaged, does not fit the task's spaces, or is not finite, and if no
    episode succeeded; `UsageError` for a missing extra.
    """
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
                f"{episode.name}: its {name} has the shape {shape}, the task's {space.shape}: is it of another task?"
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
    is_lerobot = (path / "meta/info.json").is_file()
    minari_folder = path if (path / "metadata.json").is_file() else path / "data"
    if not is_lerobot and not (minari_folder / "metadata.json").is_file():
        kinds = "an episode (.npz), a folder of episodes, or the folder of a LeRobot or Minari dataset"
        raise ArtifactError(f"{path}: no demonstrations: give {kinds}")
    try:
        return _read_lerobot(path) if is_lerobot else _read_minari(minari_folder)
    except ImportError as error:
        raise UsageError(explain_missing_package(f"--demos {path}", error.name, "demos")) from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError) as error:
        raise ArtifactError(f"{path}: damaged, or not a dataset: {describe_exception(error)}") from None


def _read_own(file: Path, task: str) -> Demonstration:
    episode = load_episode(file)
    if make_slug(episode.info.spec.task) != make_slug(task):
        raise ArtifactError(f"{file}: an episode of {episode.info.spec.task}, not of {task}")
    observations = {key: rows[: len(episode.actions)] for key, rows in split(episode.observations).items()}
    return Demonstration(
        str(file), observations, episode.actions, False if episode.info.failure else episode.info.success
    )


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
    """Read the tables of format v3.0 (many episodes in a file) or v2.1 (one); images and videos are left out."""
    features = files.read_json(folder / "meta/info.json")["features"]
    observed = [
        key for key in features if key.startswith("observation.") and features[key]["dtype"] not in ("image", "video")
    ]
    names = [*observed, "action", *({_SUCCESS} & set(features))]
    import pyarrow
    from pyarrow import parquet

    index = ["episode_index", "frame_index"]
    tables = [parquet.read_table(file, columns=[*names, *index]) for file in folder.glob("data/*/*.parquet")]
    table = pyarrow.concat_tables(tables).sort_by([(name, "ascending") for name in index])
    numbers, starts = np.unique(table["episode_index"].to_numpy(), return_index=True)
    parts = {
        name: np.split(np.array(table[name].to_pylist()).reshape(len(table), *features[name]["shape"]), starts[1:])
        for name in names
    }
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
