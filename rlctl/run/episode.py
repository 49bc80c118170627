"""Recorded episodes: `.npz` files with everything needed to reproduce one, bit for bit."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
from numpy.typing import NDArray
from pydantic import Field

from rlctl.environments.dict_spaces import Observations, split
from rlctl.environments.spec import EpisodeSpec
from rlctl.errors import ArtifactError
from rlctl.storage import files, untrusted

FORMAT = 2
"""In version 2 each event has its own random stream; episodes of version 1 can be reproduced if no event acts."""


class EpisodeInfo(pydantic.BaseModel, extra="forbid"):
    """The environment, the seed and the end of an episode."""

    format: int = FORMAT
    spec: EpisodeSpec  # what the environment was made from
    seed: int = Field(ge=0)
    policy: str = ""  # the policy's file name and training step, as text for people
    success: bool | None = None
    total_reward: float
    term_names: list[str] = []
    failure: str = ""  # the error with which the environment failed; then only the actions are known
    versions: dict[str, str] = {}


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """The data of T steps of an episode."""

    actions: NDArray[Any]  # shape (T, ...)
    observations: Observations
    """The observation before each action, and the last one: shape (T + 1, ...), or a dict of such arrays."""
    rewards: NDArray[np.float64]  # shape (T,)
    terms: NDArray[np.float64]  # raw reward terms in the order of the task's weights, shape (T, terms)


@dataclasses.dataclass(frozen=True)
class RecordedEpisode(Trajectory):
    """An episode of a file; the reward terms are in the order of `info.term_names`."""

    info: EpisodeInfo


def save_episode(path: Path, episode: RecordedEpisode) -> None:
    """Write an episode, atomically."""
    observations = split(episode.observations)
    parts = {f"observations/{key}" if key else "observations": value for key, value in observations.items()}
    files.write_npz(
        path,
        {
            "info": np.array(episode.info.model_dump_json()),
            "actions": episode.actions,
            "rewards": episode.rewards,
            "terms": episode.terms,
            **parts,
        },
    )


def load_episode(path: Path) -> RecordedEpisode:
    """Read an episode; raises `ArtifactError` if the file is missing, damaged, not ours or of a newer format."""
    arrays = files.read_npz(path)
    observed = any(key.startswith("observations") for key in arrays)
    if not observed or not {"info", "actions", "rewards", "terms"} <= arrays.keys():
        raise ArtifactError(f"{path}: not an episode of rlctl: it has no info, actions, rewards and terms")
    info = untrusted.parse_model(str(arrays["info"]), EpisodeInfo, path, "episode")
    prefix = "observations/"
    parts = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    observations: Observations = parts or arrays["observations"]
    episode = RecordedEpisode(arrays["actions"], observations, arrays["rewards"], arrays["terms"], info)
    if (problem := _find_mismatch(episode)) is not None:
        raise ArtifactError(f"{path}: damaged: {problem}")
    return episode


def _find_mismatch(episode: RecordedEpisode) -> str | None:
    """Return which array has a wrong shape or type for the number of rewards; None if all fit."""
    observations, rewards = episode.observations, episode.rewards
    if rewards.ndim != 1 or rewards.dtype != np.float64:
        return f"rewards are {_describe_array(rewards)}, not a row of float64"
    steps, names = len(rewards), len(episode.info.term_names)
    if episode.terms.shape != (steps, names) or episode.terms.dtype != np.float64:
        return f"reward terms are {_describe_array(episode.terms)}, not float64 of shape {(steps, names)}"
    parts = split(observations)
    # A failed episode has only its actions, of any number.
    acted, observed = (None, 0) if episode.info.failure and not steps else (steps, steps + 1)
    observations_and_counts = ((name, values, observed) for name, values in parts.items())
    for name, values, count in (("actions", episode.actions, acted), *observations_and_counts):
        label = name if name == "actions" else f"observations {name}".strip()
        if values.ndim == 0 or (count is not None and len(values) != count):
            return f"{label} are {_describe_array(values)}, not {count} of them"
        if values.dtype.kind not in "biuf":
            return f"{label} are {_describe_array(values)}, not numbers"
    if not np.isfinite(episode.actions).all():
        return "actions are not all finite"
    return None


def _describe_array(values: NDArray[Any]) -> str:
    return f"{values.dtype} of shape {values.shape}"
