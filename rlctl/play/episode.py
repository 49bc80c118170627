"""Recorded episodes: `.npz` files with everything needed to reproduce one, bit for bit."""

import dataclasses
import itertools
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
STEP_LABEL = "training step "  # start of `policy` of an episode of an evaluation in training; its number follows
"""In version 2 each event has its own random stream."""


class EpisodeInfo(pydantic.BaseModel, extra="forbid"):
    """The environment, the seed and the end of an episode."""

    format: int = FORMAT
    spec: EpisodeSpec  # what the environment was made from
    seed: int = Field(ge=0)
    policy: str = ""  # the policy's file name and training step, as text for people
    success: bool | None = None
    total_reward: float
    term_names: list[str] = []
    steered: bool = False
    """Whether a person changed commands or the world while it was played: then seed and actions do not reproduce it."""
    failure: str = ""  # the error with which the environment failed; then only the actions are known
    versions: dict[str, str] = {}

    @property
    def evaluated_at(self) -> int | None:
        """The training step of the evaluation that played it; None if something else did, such as a replay."""
        number = self.policy.removeprefix(STEP_LABEL)
        return int(number) if number != self.policy and number.isdecimal() else None


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """The data of T steps of an episode."""

    actions: NDArray[Any]  # shape (T, ...)
    observations: Observations  # before each action, and the last one: shape (T + 1, ...), or a dict of such arrays
    rewards: NDArray[np.float64]  # shape (T,)
    terms: NDArray[np.float64]  # raw reward terms in the order of the task's weights, shape (T, terms)


@dataclasses.dataclass(frozen=True)
class RecordedEpisode(Trajectory):
    """An episode of a file; the reward terms are in the order of `info.term_names`."""

    info: EpisodeInfo


def save_episode(path: Path, episode: RecordedEpisode) -> None:
    """Write an episode, atomically."""
    observations = split(episode.observations)
    files.write_npz(
        path,
        {
            "info": np.array(episode.info.model_dump_json()),
            "actions": episode.actions,
            "rewards": episode.rewards,
            "terms": episode.terms,
            **{f"observations/{key}" if key else "observations": value for key, value in observations.items()},
        },
    )


def save_next_episode(folder: Path, episode: RecordedEpisode) -> Path:
    """Write an episode under the next number of a folder and return its file; no other process gets that number."""
    path = _reserve_number(folder)
    try:
        save_episode(path, episode)
    except BaseException:
        files.remove(path)
        raise
    return path


def _reserve_number(folder: Path) -> Path:
    """Create an empty file under the first number after those of all episodes and recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    taken = [int(file.stem) for file in folder.glob("*.*") if file.stem.isdecimal()]
    for number in itertools.count(max(taken, default=-1) + 1):
        path = folder / f"{number:06d}.npz"
        try:
            path.touch(exist_ok=False)
        except FileExistsError:  # another process was faster
            continue
        return path
    raise AssertionError


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
    steps, actions = episode.rewards.size, episode.actions
    only_actions = bool(episode.info.failure) and not steps  # the environment failed; they are of any number
    acted = actions.shape[:1] if only_actions and actions.ndim else (steps,)
    observed = 0 if only_actions else steps + 1
    for name, values, shape in (
        ("rewards", episode.rewards, (steps,)),
        ("terms", episode.terms, (steps, len(episode.info.term_names))),
        ("actions", actions, (*acted, *actions.shape[1:])),
        *(
            (f"observations {key}".strip(), part, (observed, *part.shape[1:]))
            for key, part in split(episode.observations).items()
        ),
    ):
        if values.shape != shape or values.dtype.kind not in "biuf":
            return f"{name}: {values.dtype} of shape {values.shape}, not numbers of shape {shape}"
    if not (steps or only_actions):
        return "it has no steps"
    return None if np.isfinite(actions).all() else "actions are not all finite"
