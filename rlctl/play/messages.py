"""Messages from the main process to a worker, the worker's answer, and failures of environments."""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl import errors
from rlctl.environments.info import EnvInfo
from rlctl.environments.spec import EnvSpec
from rlctl.errors import (
    EpisodeFailed,
    RlctlError,
    ShapeError,
    TaskError,
    describe_exception,
    format_plugin_traceback,
    name_kind,
)
from rlctl.policy.actor import Exploration
from rlctl.policy.file import PolicyInfo
from rlctl.processes.pool import WorkerException


@dataclasses.dataclass(frozen=True)
class WorkerJob:
    """The environments of a worker: `count` of `total`, beginning with number `first`."""

    memory: int  # descriptor of the file of the shared arrays
    numbers: int  # descriptor of the file of a policy's numbers
    first: int
    count: int
    total: int


@dataclasses.dataclass(frozen=True)
class LabellingPolicy:
    """A policy whose actions label the steps of segments: what it would do in the student's place."""

    policy: str  # absolute path of a .safetensors or .onnx file
    spec: EnvSpec  # whose observations it sees


@dataclasses.dataclass(frozen=True)
class Build:
    """Close the environments, if there are any, and build those of a spec."""

    spec: EnvSpec
    privileged: Mapping[str, bool] | None = None  # what only the critic sees; the arguments of `TaskEnv.show_critic`
    teacher: LabellingPolicy | None = None


@dataclasses.dataclass(frozen=True)
class SetEvents:
    """Replace the events by those of a spec that is equal otherwise."""

    spec: EnvSpec
    push: dict[str, Any] | None = None  # parameters of `task.events.push`, and `every_s`, of a push that is added


@dataclasses.dataclass(frozen=True)
class Attach:
    """Map the shared arrays for segments of `steps` steps."""

    steps: int


@dataclasses.dataclass(frozen=True)
class BeginEpisodes:
    """Begin episodes and repeat actions in them."""

    episodes: dict[int, tuple[int, NDArray[Any]]]  # per environment the seed, and the actions, shape (steps, ...)
    may_fail: bool = False  # whether an episode that fails is treated as one that ended; else its error is raised


@dataclasses.dataclass(frozen=True)
class LoadPolicy:
    """Set the policy: one whose parameters are in shared memory, or another one by its name."""

    info: PolicyInfo | None = None
    layout: Sequence[tuple[str, tuple[int, ...], str]] = ()  # name, shape and dtype of each array of numbers
    other: str = ""  # an exported file, or a baseline; see `policy.named_actors.make_actor`


@dataclasses.dataclass(frozen=True)
class LimitActions:
    """Pass the actions of the loaded policy through a safety filter."""

    limits: dict[str, Any]  # a `deploy.Limits`


@dataclasses.dataclass(frozen=True)
class LevelRule:
    """How the level of an environment follows the success of its episodes."""

    start: float
    up: float
    down: float

    def follow(self, level: float, success: bool | None) -> float:
        """Return the level of the episode after one at `level`; rounded, so that equal levels are equal numbers."""
        return round(min(1.0, level + self.up) if success else max(0.0, level - self.down), 9)


@dataclasses.dataclass(frozen=True)
class Play:
    """Play a segment in some environments: the worlds of a `BatchTask` together, others one after the other."""

    steps: int  # at most so many steps in each environment
    begin: dict[int, int]  # per environment the seed of the episode to begin; negative: the running episode continues
    next_episodes: dict[int, int] = dataclasses.field(default_factory=dict)
    """Per environment the number of the training episode that follows when one ends; empty: none follows."""
    run_seed: int = 0
    levels: LevelRule | None = None  # of the episodes that follow
    exploration: Exploration = dataclasses.field(default_factory=Exploration)
    record: bool = False  # whether to write reward terms
    taught: Sequence[int] = ()  # the environments in which the teacher acts instead of the policy
    contacts: Sequence[int] = ()  # the environments in which to measure after every step how far bodies overlap


@dataclasses.dataclass(frozen=True)
class ComputeRewards:
    """Compute the rewards of goals."""

    achieved: NDArray[Any]
    desired: NDArray[Any]  # both of shape (n, *goal)


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
    row: int = dataclasses.field(default=-1, compare=False)  # the row of the segment in which it ended
    report: dict[str, Any] = dataclasses.field(default_factory=dict, compare=False)
    """The actor's report of the episode; see `Actor.report`."""
    deepest_contact: float | None = None  # how far two bodies overlapped at most [m]; None if it was not measured
    acting: float = dataclasses.field(default=0.0, compare=False)
    """Fraction of the episode's time that the policy took; the environment took the rest."""
    metrics: dict[str, float] = dataclasses.field(default_factory=dict)
    """Mean per step of each reward term of weight 0, as the task returned it."""
    drawn: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict, compare=False)
    """What the events drew last, by event."""


@dataclasses.dataclass(frozen=True)
class SharedWorld:
    """Why environments in one process would share a PyBullet world."""

    how: str
    process_bytes: int  # resident memory of a process with one environment; 0 if it is not known


@dataclasses.dataclass(frozen=True)
class Answer:
    """The answer of a worker; it contains only what the message asks for."""

    ended: Sequence[EpisodeResult] = ()  # episodes that ended while a segment was played
    left: Sequence[int] = ()  # environments whose episode ended or failed while its actions were repeated
    info: EnvInfo | None = None  # description of the environments, if it has changed
    lockstep: bool = False  # whether they are the worlds of a `BatchTask`, which play together
    shared_world: SharedWorld | None = None  # of environments that were built
    privileged: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Size of each observation that only the critic sees, by name."""
    mirror: Mapping[str, Sequence[int]] = dataclasses.field(default_factory=dict)  # the task's declaration
    rewards: NDArray[np.float64] | None = None  # those of `ComputeRewards`, shape (n,)


class FailedInEpisode(Exception):
    """An exception (the cause) was raised in a known episode."""

    def __init__(self, env: int, seed: int, step: int) -> None:
        super().__init__()
        self.where = env, seed, step

    def __str__(self) -> str:
        cause = "" if self.__cause__ is None else f"{describe_exception(self.__cause__)} "
        return "{}in environment {}, episode seed {}, step {},".format(cause, *self.where)


def describe_failure(error: BaseException) -> WorkerException:
    """Return an exception, and where it was raised, as plain data."""
    where: tuple[int, int, int] | None = None
    if isinstance(error, FailedInEpisode):
        where, error = error.where, error.__cause__ or error
    if isinstance(error, RlctlError):
        # What is wrong with a row is known here: to the main process it is a task that failed.
        kind = TaskError.__name__ if isinstance(error, ShapeError) else name_kind(error)
        return WorkerException(str(error), kind, error.details, where)
    return WorkerException(describe_exception(error), "", format_plugin_traceback(error) or None, where)


def make_error(failure: WorkerException, task: str) -> RlctlError:
    """Return the error to raise for a failure; it names the task, and the episode if there is one."""
    message, details = failure.message, failure.details
    kind = getattr(errors, failure.kind) if failure.kind else TaskError
    if kind is TaskError and task not in message.partition("\n")[0]:
        message = f"task {task!r}: {message}"
    if failure.where is not None:
        if kind is TaskError:
            return EpisodeFailed(message, *failure.where, hint=format_hint(task), details=details)
        # The policy or its server failed: check-env would not show it.
        message += "\nin environment {}, episode seed {}, step {}".format(*failure.where)
    return kind(message, details=details)


def format_hint(task: str) -> str:
    """Return the command that tests an environment without a training."""
    return f"to see it alone: rlctl check-env {shlex.quote(task)}"
