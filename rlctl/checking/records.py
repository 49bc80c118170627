"""What the child processes send, such as recorded episodes and failures, and all of it together: `Records`."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.checking.rule import NotApplicable, NotJudged, RuleFinding
from rlctl.environments.leaves import Leaf, name_element
from rlctl.errors import UsageError

FIRST_SEED, SECOND_SEED = 1000, 1001
MOST_INFOS = 100  # So many numbers of info are recorded per episode, by name
ENDS = ("terminated", "truncated", "both")


@dataclasses.dataclass(frozen=True)
class Built:
    """The environment that was built: its spaces and what it says about itself."""

    leaves: list[Leaf]  # The observation space, taken apart into arrays
    action_leaves: list[Leaf]
    observation_space: str
    action_space: str
    names: Mapping[str, int] = dataclasses.field(default_factory=dict)  # observation name -> size, of tasks only
    events: Mapping[str, bool] = dataclasses.field(default_factory=dict)  # event -> whether it acts
    max_steps: int | None = None  # The time limit it declares [steps]
    nondeterministic: bool = False  # its registration says that it is not repeatable
    truncation: str = "unknown"  # `truncated` in the code of step: `never`, `computed`, `unknown`
    counter: str = ""  # comparison in step that sets terminated by a counter
    counter_place: tuple[str, int] | None = None  # file and line of that comparison
    places: Mapping[str, tuple[str, int]] = dataclasses.field(default_factory=dict)  # of a method or a space
    accepts_seed: bool = True
    accepts_options: bool = True
    model: str = ""  # Mass, joints and limits of a model in MuJoCo
    uses_pybullet: bool = False  # Whether a PyBullet client was connected once it was built
    registered: str = ""  # the ids under which its class is registered with a time limit or arguments, and a command
    waivers: Mapping[str, str] = dataclasses.field(default_factory=dict)  # rule -> reason
    file: str | None = None  # Where its class is written
    line: int | None = None

    @property
    def parts(self) -> dict[str, slice]:
        """The parts of a flat observation by name; empty where names are not known."""
        ends = list(itertools.accumulate(self.names.values()))
        if len(self.leaves) != 1 or not ends or ends[-1] != int(np.prod(self.leaves[0].shape)):
            return {}
        return {name: slice(end - size, end) for (name, size), end in zip(self.names.items(), ends, strict=True)}

    def element(self, leaf: int, index: int) -> str:
        """Name one number of an observation by the place of its array and its flat index."""
        for name, part in self.parts.items():
            if index < part.stop:
                return name if part.stop - part.start == 1 else f"{name}[{index - part.start}]"
        return name_element(self.leaves[leaf], index)


@dataclasses.dataclass(frozen=True)
class Series:
    """The values of one leaf of the observation: those that have the leaf's shape."""

    steps: NDArray[np.int64]  # Which observation each row is; 0 is the one of `reset`. Shape (n,).
    values: NDArray[Any]  # Shape (n, *leaf.shape)

    @property
    def rows(self) -> NDArray[np.float64]:
        """The values as numbers, flat. Shape (n, elements)."""
        return self.values.reshape(len(self.values), math.prod(self.values.shape[1:])).astype(np.float64)


@dataclasses.dataclass(frozen=True)
class Form:
    """A type that something had: where it came first, and how often."""

    what: str  # `observation`, `memory`, `info memory`, `keys`, `info`, a flag, `reward`, `action`, `reset` or `step`
    type: str
    step: int
    count: int
    leaf: int | None = None
    dtype: str | None = None
    shape: tuple[int, ...] | None = None


@dataclasses.dataclass(frozen=True)
class CheckedEpisode:
    """One episode of T steps, or the part of it that was played."""

    role: str  # What it was recorded for: `episodes`, or the name of a comparison
    episode: int
    seed: int
    actions: str  # How actions were chosen: `random`, `zero` or `extreme`
    ended: str  # `terminated`, `truncated`, `both`, `raised`, `steps`, `time`, `memory`
    observations: dict[int, Series]  # Per leaf
    rewards: NDArray[np.float64]  # Shape (T,); NaN where it was no number
    reward_is_number: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: Mapping[str, Series]  # number in info -> values; `reward_terms/distance` if nested
    forms: list[Form]
    taken: NDArray[np.float64]  # The actions' numbers, see `values.flatten_action`. Shape (T, numbers)

    @property
    def steps(self) -> int:
        """How many steps were recorded."""
        return len(self.rewards)

    @property
    def has_ended(self) -> bool:
        """Whether the environment ended it."""
        return self.ended in ENDS

    def at(self, step: int, **more: Any) -> dict[str, Any]:
        """Return where a step is, and more, as a finding's evidence."""
        return {"seed": self.seed, "episode": self.episode, "actions": self.actions, "step": step, **more}


@dataclasses.dataclass(frozen=True)
class CallFailure:
    """A call into the environment that raised, did not return, or ended the process."""

    kind: str  # `raised`, `hung` or `died`
    call: str  # `load`, `build`, `reset`, `step`, `close`, `sample`, `render` or `compute_reward`
    phase: str  # The experiment, or the part of one
    episode: int
    seed: int
    step: int
    error: str
    details: str | None = None  # A traceback, or the last lines that a dying process printed
    file: Mapping[str, Any] | None = None  # one that was not found, and the searched folders
    where: tuple[str, int] | None = None  # last line of the environment's own code
    process: str = ""  # Which child process: `probe` or `instances`
    fix: str = ""  # what to do about it, where that is known

    @property
    def message(self) -> str:
        """What happened, in words: `step 7 raised ValueError: ...`."""
        names = {"step": f"step {self.step}", "load": "the import", "build": "the constructor"}
        call, verb = names.get(self.call, self.call), " raised" if self.kind == "raised" else ""
        return f"the process {self.error} in {call}" if self.kind == "died" else f"{call}{verb} {self.error}"

    @property
    def place(self) -> dict[str, Any]:
        """Where it was, as a finding's evidence."""
        place = {"call": self.call, "seed": self.seed, "episode": self.episode, "step": self.step}
        if self.details:
            place["traceback" if self.kind == "raised" else "last_output"] = self.details
        return place


@dataclasses.dataclass(frozen=True)
class Fact:
    """A result of an experiment, for checks of the parent."""

    experiment: str
    value: Any  # Plain data


@dataclasses.dataclass(frozen=True)
class Shortened:
    """An experiment was judged on less than usual, because the environment is slow."""

    experiment: str
    extent: str  # `12 of 16 episodes`


@dataclasses.dataclass(frozen=True)
class Skipped:
    """An experiment, a role of one, or a rule that cannot be judged, and why."""

    name: str
    reason: str
    applies: bool = True  # False if the environment has nothing to judge


@dataclasses.dataclass(frozen=True)
class Finished:
    """An experiment has ended: complete, by an exception of the environment, or by a bug."""

    experiment: str
    seconds: float
    is_complete: bool
    is_cut: bool = False  # time ran out: what would have happened later is unknown
    crash: str = ""  # The traceback of a bug of the experiment
    needed_s: float = 0.0  # how long all experiments of its process would take, as far as it is known then


@dataclasses.dataclass(frozen=True)
class Mistake:
    """The user named a task or a parameter that does not exist."""

    message: str


@dataclasses.dataclass(frozen=True)
class End:
    """The process has finished."""


ChildMessage = (
    Built | CheckedEpisode | CallFailure | RuleFinding | Fact | Shortened | Skipped | Finished | Mistake | End
)
OTHERS_MATTER = ("interleaved", "interleaved second", "after close")  # judged by RL401 and RL402


@dataclasses.dataclass
class Records:
    """Everything known about one environment; what the checks of the parent process read."""

    task: str
    built: Built | None = None
    trajectories: list[CheckedEpisode] = dataclasses.field(default_factory=list)
    failures: list[CallFailure] = dataclasses.field(default_factory=list)
    findings: list[RuleFinding] = dataclasses.field(default_factory=list)  # of the experiments
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)  # by experiment
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)  # experiment, role or rule -> reason
    not_applicable: dict[str, str] = dataclasses.field(default_factory=dict)  # experiment or rule -> reason
    finished: dict[str, Finished] = dataclasses.field(default_factory=dict)  # by experiment
    shortened: dict[str, str] = dataclasses.field(default_factory=dict)  # experiment -> `12 of 16 episodes`
    normalizes: Callable[[str], bool] = lambda _: False  # says whether the recipe normalises `reward` or `observation`
    derived: dict[str, Any] = dataclasses.field(default_factory=dict)  # what several rules compute from the rest
    printed_lines: int = 0  # Lines that the environment of the first process wrote to stdout
    printed_first: str = ""

    def add(self, message: ChildMessage) -> None:
        """Add one message of a child process; raises `UsageError` for a `Mistake`."""
        match message:
            case Built():
                self.built = message
            case CheckedEpisode():
                self.trajectories.append(message)
            case CallFailure():
                self.failures.append(message)
            case RuleFinding():
                self.findings.append(message)
            case Fact():
                self.facts[message.experiment] = message.value
            case Skipped():
                (self.skipped if message.applies else self.not_applicable)[message.name] = message.reason
            case Shortened():
                self.shortened[message.experiment] = message.extent
            case Finished():
                self.finished[message.experiment] = message
            case Mistake():
                raise UsageError(message.message)

    def role(self, role: str) -> list[CheckedEpisode]:
        """Return what was recorded for one purpose."""
        return [trajectory for trajectory in self.trajectories if trajectory.role == role]

    def require_built(self) -> Built:
        """Return the environment that was built; raises `NotJudged` if there is none."""
        if self.built is None:
            raise NotJudged("no instance could be built")
        return self.built

    @property
    def alone(self) -> list[CheckedEpisode]:
        """Return all episodes of instances that were alone in their process."""
        return [trajectory for trajectory in self.trajectories if trajectory.role not in OTHERS_MATTER]

    def require_alone(self) -> list[CheckedEpisode]:
        """Return the same; raises `NotJudged` if there is none."""
        episodes = self.alone
        if not any(episode.steps or episode.observations for episode in episodes):
            raise NotJudged("no episode was recorded")
        return episodes

    def forms(self, what: str) -> list[tuple[CheckedEpisode, Form]]:
        """Return every type that something had in the same episodes."""
        return [(episode, form) for episode in self.require_alone() for form in episode.forms if form.what == what]

    def series(self, leaf: int) -> list[tuple[CheckedEpisode, Series]]:
        """Return the values of a leaf of the observation in the same episodes, where there are any."""
        episodes = [episode for episode in self.require_alone() if leaf in episode.observations]
        return [(episode, episode.observations[leaf]) for episode in episodes]

    def require_role(self, role: str) -> CheckedEpisode:
        """Return the episode of a comparison; raises `NotJudged` if there is none."""
        if not (episodes := self.role(role)):
            raise NotJudged(f"the episode {role!r} could not be played")
        return episodes[0]

    def require_fact(self, experiment: str) -> Any:
        """Return what an experiment found out; raises `NotApplicable` where it has nothing to look at, and `NotJudged`
        with the reason where it found nothing out."""
        if experiment in self.not_applicable:
            raise NotApplicable(self.not_applicable[experiment])
        if experiment not in self.facts:
            raise NotJudged(self.why_missing(experiment))
        return self.facts[experiment]

    def require_whole(self, *experiments: str) -> None:
        """Raise `NotJudged` if time ran out in one of some experiments: what did not happen may have happened later."""
        cut = [name for name in experiments if name in self.finished and self.finished[name].is_cut]
        if cut:
            raise NotJudged(self.skipped.get(cut[0], f"time ran out in the experiment {cut[0]!r}"))

    def why_missing(self, experiment: str) -> str:
        """Return why an experiment was not completed."""
        if experiment in self.skipped:
            return self.skipped[experiment]
        failed = [failure for failure in self.failures if failure.phase == experiment]
        if failed:
            return f"the environment failed in {failed[0].call} during this experiment: {failed[0].error}"
        return f"the process ended before the experiment {experiment!r}"
