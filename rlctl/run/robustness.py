"""The robustness of a policy, measured by `rlctl eval --vary` and `--push`, in its run's `robustness.json`."""

from pathlib import Path
from typing import Any, Literal

import pydantic

from rlctl.policy.shipped import Interval
from rlctl.storage import files, untrusted

FORMAT = 1


class _Content(pydantic.BaseModel, extra="forbid", frozen=True):
    pass


class Outcome(_Content):
    """The scores of the episodes in one setting."""

    success_rate: float | None  # in [0, 1]; None where the task reports no success
    success_interval: Interval | None  # 95 % interval of the success rate (Clopper-Pearson)
    mean_return: float
    return_interval: Interval  # 95 % interval of the mean, by Student's t; of one episode both ends are its return


class Cell(Outcome):
    """The scores in one cell of a map."""

    values: list[float]  # one per axis
    nominal: bool  # whether every value is that of the unchanged world

    @property
    def score(self) -> tuple[float, float]:
        """Cells are ordered by the success rate, if it is reported, then by the mean return."""
        return (0.0 if self.success_rate is None else self.success_rate), self.mean_return


class Axis(_Content):
    """What is varied."""

    name: str  # as the user names it: an event (`mass`), its parameter (`push.force`) or the task's (`tolerance`)
    setting: str  # as `--set` names it: `events.mass.factor`, `task.tolerance`
    values: list[float]
    nominal: float | None  # the value in the unchanged world; None if it is not a single number
    whole: bool = False  # whether only whole numbers are possible


class RobustnessMap(_Content):
    """One or two axes varied together; everything else is nominal."""

    axes: list[Axis]
    cells: list[Cell]  # for every combination of the axes' values; the value of the last axis changes fastest

    def name_cell(self, cell: Cell) -> str:
        """Return where a cell is: `mass 0.6, friction 0.2`."""
        return ", ".join(f"{axis.name} {value:g}" for axis, value in zip(self.axes, cell.values, strict=True))


class PushLevel(Outcome):
    """The scores with pushes of one impulse."""

    impulse: float  # force times duration [N s]
    held: float  # fraction of the episodes that went well, in [0, 1], as `PushTest.measure` defines it


class PushTest(_Content):
    """The smallest horizontal push at mid-episode at which the policy fails."""

    body: str
    link: str | None  # none: the base of the body
    duration_s: float  # how long a push lasts [s]
    mass: float  # of the whole body [kg]
    measure: Literal["success", "upright"]  # `upright`: an episode goes well if it lasts until its time limit
    levels: list[PushLevel]  # by impulse; the first is without a push
    threshold: float | None  # impulse [N s] at which half of the episodes fail; None: cannot tell
    threshold_interval: Interval | None  # 95 % interval, by resampling episodes
    verdict: str  # the result as a sentence


class Robustness(_Content):
    """The measurements of one policy."""

    format: int = FORMAT
    task: str
    parameters: dict[str, Any]
    reward_weights: dict[str, float] = {}
    events: dict[str, dict[str, Any]] = {}  # events that are active in every cell; see `EnvSpec.events`
    policy_file: str
    algo: str
    training_steps: int
    episodes: int  # in every cell, with the same seeds
    seed: int
    deterministic: bool
    nominal: Outcome  # with nothing varied
    maps: list[RobustnessMap] = []
    push: PushTest | None = None
    command: str = ""  # the command that measured it
    versions: dict[str, str] = {}

    def find_worst(self) -> tuple[RobustnessMap, Cell] | None:
        """Return the worst cell of all maps with its map; None where nothing was varied."""
        cells = ((varied, cell) for varied in self.maps for cell in varied.cells)
        return min(cells, key=lambda pair: pair[1].score, default=None)


def write(path: Path, result: Robustness) -> None:
    """Write a result, atomically."""
    files.write_json(path, result.model_dump(mode="json"))


def read(path: Path) -> Robustness:
    """Read a result; raises `ArtifactError` if it is missing, damaged, not ours or of a newer format."""
    return untrusted.parse_model(untrusted.read_bytes(path, untrusted.JSON_LIMIT), Robustness, path, "robustness")
