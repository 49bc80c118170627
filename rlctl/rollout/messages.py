"""What the main process asks of a worker: each request a named message, sent as JSON."""

from __future__ import annotations

import dataclasses
import json
from typing import Any


@dataclasses.dataclass(frozen=True)
class Build:
    """Close the environments and build those of another spec."""

    spec: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class SetEvents:
    """Let the events of another spec act, which differs in nothing else."""

    spec: dict[str, Any]
    push: dict[str, Any] | None = None
    """Parameters of `rlctl.task.events.push` and `every_s`: a push that the task does not offer."""


@dataclasses.dataclass(frozen=True)
class Attach:
    """Map the shared arrays, with room for segments of `steps` steps."""

    steps: int


@dataclasses.dataclass(frozen=True)
class Reset:
    """Begin episodes: pairs of environment and seed; a negative seed lets the environment rest."""

    seeds: list[list[int]]


@dataclasses.dataclass(frozen=True)
class Step:
    """Step every active environment with its row of `arrays.action`."""


@dataclasses.dataclass(frozen=True)
class ReplayActions:
    """Begin episodes and take the steps of the actions that follow as bytes: (environment, seed, steps) each."""

    episodes: list[list[int]]


@dataclasses.dataclass(frozen=True)
class ComputeRewards:
    """Compute the rewards of the goals that follow as bytes."""


@dataclasses.dataclass(frozen=True)
class LoadPolicy:
    """Act with a policy from now on: one whose numbers are in shared memory, or another one by its name."""

    info: dict[str, Any] | None = None
    """A `PolicyInfo`."""
    layout: list[Any] = dataclasses.field(default_factory=list)
    """Name, shape and dtype of each array of numbers."""
    other: str = ""
    """An exported file, or a baseline; see `baselines.make_player`."""


@dataclasses.dataclass(frozen=True)
class LimitActions:
    """Send the actions of the policy that was loaded through a safety filter."""

    limits: dict[str, Any]
    """A `deploy.Limits`."""


@dataclasses.dataclass(frozen=True)
class Play:
    """Play up to `steps` steps in some environments, one after the other."""

    envs: list[int]
    begin: list[int]
    """Seed of the episode to begin with, per environment; negative: the running one goes on."""
    steps: int
    exploration: dict[str, Any]
    until_end: bool
    """Whether to stop where an episode ends."""
    record: bool
    """Whether to write reward terms."""
    run_seed: int = 0
    episodes_started: list[int] = dataclasses.field(default_factory=list)
    """Per environment the number of the training episode that begins where one ends; empty: none begins."""
    contacts: bool = False
    """Whether to measure, after every step, how far bodies overlap."""


Message = Build | SetEvents | Attach | Reset | Step | ReplayActions | ComputeRewards | LoadPolicy | LimitActions | Play
_TYPES: dict[str, type[Message]] = {
    each.__name__: each
    for each in (Build, SetEvents, Attach, Reset, Step, ReplayActions, ComputeRewards, LoadPolicy, LimitActions, Play)
}


def encode(message: Message) -> bytes:
    """Return a message as JSON."""
    return json.dumps({"message": type(message).__name__, **dataclasses.asdict(message)}).encode()


def decode(content: bytes) -> Message:
    """Return the message of some JSON."""
    fields = json.loads(content)
    return _TYPES[fields.pop("message")](**fields)
