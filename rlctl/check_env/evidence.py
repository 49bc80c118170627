"""What the probe saw, as plain data that rules read. No environment code runs here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlctl.check_env import results
from rlctl.check_env.leaves import Leaf, leaf_from_wire, leaf_name

Arrays = dict[str, NDArray[Any]]

FIRST_SEED = 1000
SECOND_SEED = 1001

GYMNASIUM, SB3 = "Gymnasium", "Stable-Baselines3"
RAISED = "the environment raised "
"""How a complaint of a library's checker begins that is the environment's own exception."""

MOST_INFOS = 100
"""So many numbers of info are recorded per episode, by name."""
ENDS = ("terminated", "truncated", "both")


@dataclasses.dataclass(frozen=True)
class Built:
    """The environment that was built: its spaces and what it tells about itself."""

    leaves: list[Leaf]
    """The observation space, taken apart into arrays."""
    action_leaves: list[Leaf]
    observation_space: str
    action_space: str
    names: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Size per observation name in the order of a flat observation; empty where names are not known."""
    max_steps: int | None = None
    """The time limit it declares [steps]."""
    nondeterministic: bool = False
    """Whether its Gymnasium registration says that equal seeds may give unequal episodes."""
    accepts_seed: bool = True
    is_env: bool = True
    """Whether it inherits from `gymnasium.Env`."""
    is_old_gym: bool = False
    """Whether it inherits from the old gym."""
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    uses_pybullet: bool = False
    """Whether a PyBullet client was connected once it was built."""
    waivers: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Per rule that its class waives, the reason."""
    file: str | None = None
    """Where its class is written."""
    line: int | None = None

    def element(self, leaf: int, index: int) -> str:
        """Name one number of an observation by the place of its array and its flat index."""
        where = leaf_name(self.leaves[leaf])
        if len(self.leaves) == 1 and sum(self.names.values()) == int(np.prod(self.leaves[0].shape)):
            offset = index
            for name, size in self.names.items():
                if offset < size:
                    return f"{name}[{offset}]" if size > 1 else name
                offset -= size
        if not self.leaves[leaf].shape:
            return where
        position = np.unravel_index(index, self.leaves[leaf].shape)
        return f"{where}[{', '.join(str(int(i)) for i in position)}]"


@dataclasses.dataclass(frozen=True)
class Series:
    """The values of one leaf of the observation: those that have the leaf's shape."""

    steps: NDArray[np.int64]
    """Which observation each row is; 0 is the one of `reset`. Shape (n,)."""
    values: NDArray[Any]
    """Shape (n, *leaf.shape)."""


@dataclasses.dataclass(frozen=True)
class Form:
    """A type that something had: where it was first seen, and how often."""

    what: str
    """`observation`, `memory`, `keys`, `reward`, `terminated`, `truncated`, `info`, `reset` or `step`."""
    type: str
    step: int
    count: int
    leaf: int | None = None
    dtype: str | None = None
    shape: tuple[int, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """One episode of T steps, or the part of it that was lived."""

    role: str
    """What it was lived for: `episodes`, or the name of a comparison."""
    episode: int
    seed: int
    actions: str
    """How actions were chosen: `random`, `zero` or `extreme`."""
    ended: str
    """`terminated`, `truncated`, `both`, `raised`, or what cut it: `steps`, `time`, `memory`."""
    observations: dict[int, Series]
    """Per leaf."""
    rewards: NDArray[np.float64]
    """Shape (T,); NaN where it was no number."""
    reward_is_number: NDArray[np.bool_]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    action_values: NDArray[np.float64]
    """Numbers of each action, in the order of the action space's leaves. Shape (T, A)."""
    infos: Mapping[str, Series]
    """Numbers in info, by name; those in a dictionary of info as `reward_terms/distance`. Values have shape (n,)."""
    forms: list[Form]
    step_s: float
    """Time in `step`, summed [s]."""
    reset_s: float

    @property
    def steps(self) -> int:
        return len(self.rewards)

    @property
    def has_ended(self) -> bool:
        return self.ended in ENDS

    @property
    def place(self) -> dict[str, Any]:
        """Seed, episode and kind of actions, for a finding's evidence."""
        return {"seed": self.seed, "episode": self.episode, "actions": self.actions}


@dataclasses.dataclass(frozen=True)
class Failure:
    """A call into the environment that raised, never came back, or ended the process."""

    kind: str
    """`raised`, `hung` or `died`."""
    call: str
    """`load`, `build`, `reset`, `step`, `close`, `sample`, `check`."""
    part: str
    """Which child process: `probe`, `instances` or `checkers`."""
    phase: str
    episode: int
    seed: int
    step: int
    error: str
    details: str | None = None
    """A traceback, or the last lines that a dying process printed."""
    file: Mapping[str, Any] | None = None
    """A file that was not found, as in `LoadError`."""


@dataclasses.dataclass(frozen=True)
class LoadError:
    """Why no environment could be made."""

    kind: str
    """`import`, `constructor`, `class`, `arguments`, `file`, `old gym` or `no environment`."""
    message: str
    details: str | None
    missing: list[str]
    """Constructor arguments that have no value."""
    file: Mapping[str, Any] | None
    """A file that was not found: its name, the folders that were searched, and a similar file."""


@dataclasses.dataclass(frozen=True)
class Complaint:
    """What a library's own checker said."""

    checker: str
    """`Gymnasium` or `Stable-Baselines3`."""
    kind: str
    """`error` (it refused the environment) or `warning`."""
    text: str


@dataclasses.dataclass
class Evidence:
    """Everything known about one environment."""

    task: str
    built: Built | None = None
    load_error: LoadError | None = None
    trajectories: list[Trajectory] = dataclasses.field(default_factory=list)
    failures: list[Failure] = dataclasses.field(default_factory=list)
    complaints: list[Complaint] = dataclasses.field(default_factory=list)
    checkers: dict[str, str | None] = dataclasses.field(default_factory=dict)
    """Per checker that was tried: None, or why it could not run."""
    results: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Per kind of result, by the name of its class in `results`."""
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """Per study that was done, how long it took."""
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)
    """Studies and parts of them that were not done, and why."""
    crashes: dict[str, str] = dataclasses.field(default_factory=dict)
    """Per study that crashed by itself, its traceback."""
    normalizes: bool | None = None
    """Whether the packaged recipe normalises observations; None without a recipe."""
    printed_lines: int = 0
    """Lines that the probe's environment wrote to stdout."""
    printed_first: str = ""

    def role(self, role: str) -> list[Trajectory]:
        """Return what was lived for one purpose."""
        return [each for each in self.trajectories if each.role == role]

    @property
    def episodes(self) -> list[Trajectory]:
        """Return the whole episodes of the probe."""
        return self.role("episodes")

    def add(self, header: Mapping[str, Any], arrays: Arrays) -> None:
        """Take in one message of a child process."""
        content = {key: value for key, value in header.items() if key not in ("type", "part")}
        kind, part = header["type"], header.get("part")
        if kind == "built" and part == "probe":
            self.built = _built(content, arrays)
        elif kind == "trajectory":
            self.trajectories.append(_trajectory(content, arrays))
        elif kind == "failure":
            self.failures.append(Failure(part=str(part), **content))
        elif kind == "load_error":
            if part == "probe":
                self.load_error = LoadError(**content)
            else:
                failed = Failure("raised", "build", str(part), "build", 0, 0, 0, content["message"])
                self.failures.append(failed)
        elif kind == "crashed":
            self.crashes[content["study"]] = content["traceback"]
        elif kind == "result":
            self.results[content["kind"]] = results.decode(content["kind"], content["content"])
        elif kind == "studied":
            self.seconds[content["study"]] = content["seconds"]
        elif kind == "skipped":
            self.skipped[content["role"]] = content["reason"]
        elif kind == "checked":
            self.checkers[content["checker"]] = content["problem"]
            self.complaints += [Complaint(**each) for each in content["complaints"]]


def _built(content: dict[str, Any], arrays: Arrays) -> Built:
    def leaves(name: str) -> list[Leaf]:
        described: Sequence[dict[str, Any]] = content.pop(name)
        return [
            leaf_from_wire(each, arrays.get(f"{name}/{i}/low"), arrays.get(f"{name}/{i}/high"))
            for i, each in enumerate(described)
        ]

    return Built(leaves=leaves("leaves"), action_leaves=leaves("action_leaves"), **content)


def _trajectory(content: dict[str, Any], arrays: Arrays) -> Trajectory:
    forms = [
        Form(**{**each, "shape": None if each["shape"] is None else tuple(each["shape"])})
        for each in content.pop("forms")
    ]
    infos = {
        name: Series(arrays[f"info/{i}/steps"], arrays[f"info/{i}/values"])
        for i, name in enumerate(content.pop("infos"))
    }
    observations = {leaf: Series(arrays[f"steps/{leaf}"], arrays[f"values/{leaf}"]) for leaf in content.pop("recorded")}
    return Trajectory(
        **content,
        forms=forms,
        observations=observations,
        infos=infos,
        action_values=arrays.get("actions", np.zeros((0, 0))),
        rewards=arrays["rewards"],
        reward_is_number=arrays["reward_is_number"],
        terminated=arrays["terminated"],
        truncated=arrays["truncated"],
    )
