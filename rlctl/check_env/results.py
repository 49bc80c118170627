"""What studies find out beside whole lives, as plain data: a class per result, sent as JSON."""

from __future__ import annotations

import dataclasses

from rlctl.check_env.world_results import Worlds  # noqa: F401


@dataclasses.dataclass(frozen=True)
class GlobalRandom:
    """Use of random generators that belong to the whole process."""

    uses: list[GlobalUse]


@dataclasses.dataclass(frozen=True)
class GlobalUse:
    """One generator, and the first call that moved it."""

    generator: str
    """`numpy.random`, `random` or `torch`."""
    call: str
    """`build`, `reset` or `step`."""
    step: int


@dataclasses.dataclass(frozen=True)
class Leaks:
    """Counts after each reset of one instance: what it keeps of earlier episodes."""

    clients: list[int]
    """PyBullet clients of the process."""
    bodies: list[int]
    """Bodies in the worlds of all clients."""
    descriptors: list[int]
    threads: list[int]
    memory: list[int]
    """Resident memory [bytes] once the warm-up is over, half way, and at the end; empty where it is not known."""
    measured: list[int]
    """After how many resets each of these was measured."""


@dataclasses.dataclass(frozen=True)
class SharedSpaces:
    """What two instances have in common."""

    objects: list[str]
    """`action_space` and `observation_space`, where it is one object."""
    generators: list[str]
    """The same, where only the random generator is."""


@dataclasses.dataclass(frozen=True)
class Attributes:
    """Attributes that wrappers and learners use."""

    problems: list[str]
    truncation: str
    """What the code of `step` says of `truncated`: `never` (always False), `computed`, or `unknown`."""


@dataclasses.dataclass(frozen=True)
class Windows:
    """Windows that opened unasked."""

    gui_clients: int
    """PyBullet clients with a window, though no render mode was asked for."""


@dataclasses.dataclass(frozen=True)
class WorkerBuild:
    """An instance built in a daemonic process that `multiprocessing` spawned."""

    kind: str
    """`done`, `raised`, `died`, `hung` or `unknown`."""
    call: str
    """How far it came: `import`, `load`, `build`, `reset`, `step` or `close`."""
    error: str
    details: str | None = None


@dataclasses.dataclass(frozen=True)
class StepBeforeReset:
    """A step of an instance that was not reset."""

    raised: str | None


@dataclasses.dataclass(frozen=True)
class CloseTwice:
    """Closing an instance that is closed."""

    raised: str | None


@dataclasses.dataclass(frozen=True)
class AfterEnd:
    """Steps after the end of an episode."""

    seed: int
    ended: int
    """The step that ended it."""
    steps: int
    """How many were taken after it."""
    raised: str | None
    rewards: list[float]
    """The finite ones."""
    problems: list[AfterEndProblem]


@dataclasses.dataclass(frozen=True)
class AfterEndProblem:
    """Something that came back after the end and is no observation or reward."""

    kind: str
    """`shape`, `not finite` or `outside`."""
    what: str
    """The observation's part, or the reward."""
    step: int
    value: str
    expected: str


@dataclasses.dataclass(frozen=True)
class Rendering:
    """Pictures of an environment."""

    attempts: list[RenderAttempt]


@dataclasses.dataclass(frozen=True)
class RenderAttempt:
    """One render mode."""

    mode: str
    problem: str
    """`missing` (a library), `build`, `render`, `type`, `plain` (a picture of one colour), or empty."""
    text: str
    """What was raised or returned instead."""


@dataclasses.dataclass(frozen=True)
class Speed:
    """How long steps and resets take, and what takes that long."""

    step_s: float | None
    """A step with a random action, with nothing measured but time [s]; None where none could be taken."""
    reset_s: float | None
    steps: int
    """How many were timed."""
    resets: int
    slowest_in_step: list[TimedCall]
    """By their own time, what they call left out; the slowest first."""
    slowest_in_reset: list[TimedCall]
    suspicious_in_step: list[TimedCall]
    """Calls that step should not make, with what they call; none is inside another."""
    suspicious_in_reset: list[TimedCall]
    rebuilds: bool
    """Whether it is a task of rlctl that says itself that every reset loads the world anew."""


@dataclasses.dataclass(frozen=True)
class TimedCall:
    """The calls of one function in all steps, or in all resets."""

    name: str
    """`pybullet.stepSimulation`."""
    place: str
    """Where in the environment's code most of its time goes, `file.py:12`; empty if that is not known."""
    share: float
    """Its part of the time of all steps, or of all resets."""
    kind: str = ""
    """`rendering`, `sleeping`, `loading` or `connecting`, for what is suspicious."""
    inside: str = ""
    """Another suspicious function that it calls itself."""
