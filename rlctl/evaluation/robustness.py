"""What `rlctl eval --vary` varies, and what it and `--push` measured, as in a run's `robustness.json`."""

import dataclasses
import inspect
import math
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pydantic

from rlctl.engine import Engine
from rlctl.environments.parameters import read_parameters
from rlctl.environments.registry import is_task
from rlctl.environments.spec import EnvChanges, EnvSpec
from rlctl.errors import UsageError, check_name, did_you_mean, short_repr
from rlctl.policy.shipped import Interval
from rlctl.storage import untrusted
from rlctl.task.events import OF_APPEARANCE, Event, RangeLimits
from rlctl.task.events.event import read_range

FORMAT = 1
ALL = "all"
_MOST_VALUES = 1000  # of an axis
_VALUES = 5  # per axis of `--vary all`
_WIDER = 2.0  # width of an axis of `--vary all`, relative to the event's range
_FORM = f"write NAME=LOWEST:HIGHEST:VALUES with 2 to {_MOST_VALUES:,} values, for example --vary mass=0.6:1.4:9"
SIM = "sim"  # the setting of the axis whose values are MuJoCo's contacts
SOLREFS = [0.02, 0.01, 0.005]  # [s], from MuJoCo's default to contacts about as stiff as PyBullet's


class _Content(pydantic.BaseModel, extra="forbid", frozen=True):
    pass


class Outcome(_Content):
    """The scores of the episodes in one setting."""

    success_rate: float | None  # in [0, 1]; None where the task reports no success
    success_interval: Interval | None  # 95 % interval of the success rate (Clopper-Pearson)
    mean_return: float
    return_interval: Interval  # 95 % interval of the mean, by Student's t; of one episode both ends are its return

    @property
    def score(self) -> tuple[float, float]:
        """Outcomes are ordered by the success rate, if it is reported, then by the mean return."""
        return (0.0 if self.success_rate is None else self.success_rate), self.mean_return


class Cell(Outcome):
    """The scores in one cell of a map."""

    values: list[float]  # one per axis
    nominal: bool  # whether every value is that of the unchanged world


class Failure(_Content):
    """Why the environment could not play the episodes in one setting."""

    failure: str  # the first line of the error


class FailedCell(Failure):
    """A cell of a map that has no scores; it is worse than any other."""

    values: list[float]  # one per axis
    nominal: bool  # whether every value is that of the unchanged world


class Axis(_Content):
    """What is varied."""

    name: str  # as the user names it: an event (`mass`), its parameter (`push.force`) or the task's (`tolerance`)
    setting: str  # as `--set` names it: `events.mass.factor`, `task.tolerance`
    values: list[float]
    nominal: float | None  # the value in the unchanged world; None if it is not a single number
    whole: bool = False  # whether only whole numbers are possible

    @property
    def label(self) -> str:
        """What the values are: the parameter of an event (`mass.factor`), or of the task (`tolerance`)."""
        return self.name if self.setting == SIM else self.setting.partition(".")[2]


class RobustnessMap(_Content):
    """One or two axes varied together; everything else is nominal."""

    axes: list[Axis]
    cells: list[Cell | FailedCell]
    """For every combination of the axes' values; the value of the last axis changes fastest."""

    @property
    def has_success(self) -> bool:
        """Whether the task reports success."""
        return any(cell.success_rate is not None for cell in self.played)

    @property
    def played(self) -> list[Cell]:
        """The cells that have scores."""
        return [cell for cell in self.cells if isinstance(cell, Cell)]

    @property
    def failed(self) -> list[FailedCell]:
        """The cells in which the environment failed."""
        return [cell for cell in self.cells if isinstance(cell, FailedCell)]

    def name_cell(self, cell: Cell | FailedCell) -> str:
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
    randomize: bool = False  # whether all events of the task are active in every cell
    own_settings: list[str] = []  # of the above, as `--set` names them, those that the policy file itself has
    sim: Engine = Engine()  # in which the cells were played; no choice: the policy's own
    other_task: str | None = None  # on which the policy was played; None: on that of its training
    policy_file: str  # or what `--policy` names: no file of rlctl, without algorithm and steps
    is_baseline: bool = False  # whether `--policy` named the policy
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

    def name_worst(self) -> tuple[str, Outcome]:
        """Return name and scores of the worst cell of all maps, or of the nominal setting where no cell is worse."""
        worst = self.find_worst()
        if worst is None:
            return "nominal", self.nominal
        varied, cell = worst
        return varied.name_cell(cell), cell

    def find_worst(self) -> tuple[RobustnessMap, Cell] | None:
        """Return the worst cell of all maps that has scores, with its map; None where the nominal setting is worse."""
        cells = ((varied, cell) for varied in self.maps for cell in varied.played)
        worst = min(cells, key=lambda pair: pair[1].score, default=None)
        if worst is None or self.nominal.score < worst[1].score:
            return None
        return worst

    def list_failed(self) -> list[str]:
        """Return a line for each cell in which the environment failed."""
        pairs = [(varied, cell) for varied in self.maps for cell in varied.failed]
        return [f"{varied.name_cell(cell)}: {cell.failure}" for varied, cell in pairs]


def read(path: Path) -> Robustness:
    """Read a result; raises `ArtifactError` if it is missing, damaged, not ours or of a newer format."""
    return untrusted.parse_model(untrusted.read_bytes(path, untrusted.JSON_LIMIT), Robustness, path, "robustness")


def read_axes(texts: Sequence[str], spec: EnvSpec) -> list[list[Axis]]:
    """Return the axes of each map of `--vary`: a single map, or with `all` one per event of the task.

    The axis `sim` has time constants of MuJoCo's contacts [s]: `sim=LOWEST:HIGHEST:VALUES`, or only `sim` for a soft, a
    medium and a stiff one.
    """
    task = spec.constructor()
    if list(texts) == [ALL]:
        return [[axis] for axis in _vary_all(task, spec)]
    if ALL in texts or len(texts) > 2:
        raise UsageError("--vary: give one or two axes, or only `all`, which varies each event alone")
    axes = [_read_axis(text, task, spec) for text in texts]
    if len({axis.setting for axis in axes}) < len(axes):
        raise UsageError(f"--vary: {axes[0].setting} is given twice")
    return [axes]


def apply_axes(axes: Sequence[Axis], values: Sequence[float], spec: EnvSpec) -> EnvSpec:
    """Return an environment in which axes have these values."""
    for axis, value in zip(axes, values, strict=True):
        kind, _, rest = axis.setting.partition(".")
        if axis.setting == SIM:
            spec = dataclasses.replace(spec, sim=Engine("mujoco", value))
        elif kind == "events":
            event, _, parameter = rest.partition(".")
            spec = EnvChanges(events={event: {parameter: value}}).apply(spec)
        else:
            number = int(value) if value.is_integer() and axis.whole else value
            spec = EnvChanges(parameters={rest: number}).apply(spec)
    return spec


def _read_axis(text: str, task: Any, spec: EnvSpec) -> Axis:
    name, equals, values = text.partition("=")
    name, parts = name.strip(), values.split(":")
    if name == SIM and not equals:
        return _vary_contacts(SOLREFS, task, spec)
    try:
        if not equals or len(parts) != 3:
            raise ValueError
        low, high, count = float(parts[0]), float(parts[1]), int(parts[2])
        if not (-math.inf < low < high < math.inf and 2 <= count <= _MOST_VALUES):
            raise ValueError
    except ValueError:
        raise UsageError(f"--vary {short_repr(text)!r}: {_FORM}; for a single value use --set") from None
    if name == SIM:
        if low <= 0 or high >= 1:
            raise UsageError(f"--vary {text}: the time constant of MuJoCo's contacts is between 0 and 1 s")
        return _vary_contacts(_spread((low, high, count), whole=False), task, spec)
    events: Mapping[str, Event] = task.events if is_task(task) else {}
    event, _, parameter = name.removeprefix("events.").partition(".")
    if event in events:
        return _vary_event(name, event, parameter, events[event], (low, high, count), spec)
    return _vary_parameter(name, task, (low, high, count), spec)


def _vary_contacts(solrefs: list[float], task: Any, spec: EnvSpec) -> Axis:
    if not is_task(task):
        raise UsageError(f"--vary sim: {spec.task} is a plain Gymnasium environment; only tasks run in another engine")
    return Axis(name="mujoco solref", setting=SIM, values=solrefs, nominal=None)


def _vary_event(
    name: str, key: str, parameter: str, event: Event, span: tuple[float, float, int], spec: EnvSpec
) -> Axis:
    ranges = event.ranges
    parameter = parameter or next(iter(ranges), name)
    check_name(parameter, ranges, f"--vary {name}: event {key!r} has no random parameter", UsageError)
    limits = ranges[parameter]
    read_range(f"--vary {name}", list(span[:2]), RangeLimits(limits.low, limits.high, limits.above), UsageError)
    return Axis(
        name=name,
        setting=f"events.{key}.{parameter}",
        values=_spread(span, limits.whole),
        nominal=None if spec.randomize or event.enabled or key in spec.events else event.nominal(parameter),
        whole=limits.whole,
    )


def _spread(span: tuple[float, float, int], whole: bool) -> list[float]:
    values = np.linspace(*span).round(12).tolist()
    return sorted({float(round(value)) for value in values}) if whole else values


def _vary_parameter(name: str, task: Any, span: tuple[float, float, int], spec: EnvSpec) -> Axis:
    parameter = name.removeprefix("task.")
    if is_task(task):
        hints = typing.get_type_hints(task)
        numbers = {name: hints[name] for name in task.parameters() if hints[name] in (int, float)}
        if parameter not in numbers:
            known = [*task.events, *numbers]
            raise UsageError(
                f"--vary {name}: {spec.task} has no event or number of that name.{did_you_mean(parameter, known)} "
                f"It has: {', '.join(known) or 'nothing that can be varied'}."
            )
        whole = numbers[parameter] is int
        nominal = task.parameters()[parameter].default
    else:
        declared = (read_parameters(task) or {}).get(parameter)
        nominal = None if declared is None else declared.default
        whole = declared is not None and _is_whole(declared, _spread(span, whole=False))
    nominal = spec.parameters.get(parameter, nominal)
    return Axis(
        name=name,
        setting=f"task.{parameter}",
        values=_spread(span, whole),
        nominal=float(nominal) if isinstance(nominal, int | float) else None,
        whole=whole,
    )


def _is_whole(declared: inspect.Parameter, values: Sequence[float]) -> bool:
    if declared.annotation is not declared.empty:
        return declared.annotation in (int, "int")
    return type(declared.default) is int and all(value.is_integer() for value in values)


def _vary_all(task: Any, spec: EnvSpec) -> list[Axis]:
    if not is_task(task) or not task.events:
        raise UsageError(f"--vary all: {spec.task} has no events; name one of its parameters")
    events = {name: event for name, event in task.events.items() if event.ranges}
    if not set(spec.observe) & set(task.cameras):  # looks matter only to policies that see by a camera
        events = {name: event for name, event in events.items() if event.function not in OF_APPEARANCE}
    spans = {name: _widen(event) for name, event in events.items()}
    return [
        _vary_event(name, name, "", event, spans[name], spec)
        for name, event in events.items()
        if spans[name][0] < spans[name][1]
    ]


def _widen(event: Event) -> tuple[float, float, int]:
    """Return the range of an event's first parameter, widened around its nominal value, or its middle."""
    parameter, limits = next(iter(event.ranges.items()))
    low, high = read_range(parameter, event.parameters.get(parameter, 0.0), limits).at(1.0)
    middle = event.nominal(parameter)
    middle = (low + high) / 2 if middle is None else middle
    lowest, highest = middle - _WIDER * max(middle - low, 0.0), middle + _WIDER * max(high - middle, 0.0)
    if lowest < limits.low or (limits.above and lowest == limits.low):
        lowest = low / 2 if limits.above else limits.low
    return lowest, min(highest, limits.high), _VALUES
