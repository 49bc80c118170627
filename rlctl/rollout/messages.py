"""What the main process asks of a worker, each request a named message, and what it answers."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.policy.file import PolicyInfo
from rlctl.policy.players.player import Exploration


@dataclasses.dataclass(frozen=True)
class WorkerJob:
    """What a worker is for: `count` of `total` environments, from number `first` on."""

    memory: int
    """Descriptor of the file of the shared arrays."""
    numbers: int
    """Descriptor of the file of a policy's numbers."""
    first: int
    count: int
    total: int


@dataclasses.dataclass(frozen=True)
class Build:
    """Close the environments, if there are any, and build those of a spec."""

    spec: EnvSpec


@dataclasses.dataclass(frozen=True)
class SetEvents:
    """Let the events of another spec act, which differs in nothing else."""

    spec: EnvSpec
    push: dict[str, Any] | None = None
    """Parameters of `rlctl.task.events.push` and `every_s`: a push that the task does not offer."""


@dataclasses.dataclass(frozen=True)
class Attach:
    """Map the shared arrays, with room for segments of `steps` steps."""

    steps: int


@dataclasses.dataclass(frozen=True)
class BeginEpisodes:
    """Begin episodes, and take the steps of some actions."""

    episodes: dict[int, tuple[int, NDArray[Any]]]
    """Per environment the seed, and the actions so far, shape (steps, ...)."""
    may_fail: bool = False
    """Whether an episode that fails is only reported, as one that ended."""


@dataclasses.dataclass(frozen=True)
class LoadPolicy:
    """Act with a policy from now on: one whose numbers are in shared memory, or another one by its name."""

    info: PolicyInfo | None = None
    layout: list[tuple[str, tuple[int, ...], str]] = dataclasses.field(default_factory=list)
    """Name, shape and dtype of each array of numbers."""
    other: str = ""
    """An exported file, or a baseline; see `players.named.make_player`."""


@dataclasses.dataclass(frozen=True)
class LimitActions:
    """Send the actions of the policy that was loaded through a safety filter."""

    limits: dict[str, Any]
    """A `deploy.Limits`."""


@dataclasses.dataclass(frozen=True)
class Play:
    """Play a segment in some environments, one after the other."""

    steps: int
    """Of each environment, at most."""
    begin: dict[int, int]
    """Per environment the seed of the episode to begin with; negative: the running one goes on."""
    next_episodes: dict[int, int] = dataclasses.field(default_factory=dict)
    """Per environment the number of the training episode that begins where one ends; empty: none begins."""
    run_seed: int = 0
    exploration: Exploration = dataclasses.field(default_factory=Exploration)
    record: bool = False
    """Whether to write reward terms."""
    contacts: bool = False
    """Whether to measure, after every step, how far bodies of a task overlap."""


@dataclasses.dataclass(frozen=True)
class ComputeRewards:
    """Compute the rewards of goals."""

    achieved: NDArray[Any]
    desired: NDArray[Any]
    """Both of shape (n, *goal)."""


Message = Build | SetEvents | Attach | BeginEpisodes | LoadPolicy | LimitActions | Play | ComputeRewards


@dataclasses.dataclass(frozen=True)
class EpisodeResult:
    """How an episode ended. `terms` are sums over the episode, weighted: they add up to the return."""

    env: int
    seed: int
    total_reward: float
    length: int
    success: bool | None
    terms: dict[str, float]
    final_distance: float | None
    row: int = dataclasses.field(default=-1, compare=False)
    """The row of the segment in which it ended."""
    report: dict[str, Any] = dataclasses.field(default_factory=dict, compare=False)
    """What the player has to say of it; see `acting.Player.report`."""
    deepest_contact: float | None = None
    """How far two bodies overlapped at most [m]; None where it was not measured."""
    acting: float = dataclasses.field(default=0.0, compare=False)
    """The part of its time that the policy took, the environment the rest."""
    metrics: dict[str, float] = dataclasses.field(default_factory=dict)
    """Mean per step of each reward term of weight 0, as the task returned it."""


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a worker answers to a message; each fills in what is asked."""

    ended: list[EpisodeResult] = dataclasses.field(default_factory=list)
    """Episodes that ended while a segment was played."""
    left: list[int] = dataclasses.field(default_factory=list)
    """Environments that are not in the episode that they were to begin: it ended, or failed, on the way."""
    info: EnvInfo | None = None
    """What the environments are, where that has changed."""
    rewards: NDArray[np.float64] | None = None
    """Those of `ComputeRewards`, shape (n,)."""
