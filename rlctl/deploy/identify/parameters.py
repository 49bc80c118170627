"""The physical values that a log can determine: those of events that hold for a whole episode, and the delay."""

import dataclasses
import math
from collections.abc import Collection, Mapping

from rlctl.errors import UsageError, check_name
from rlctl.task.events import Event, delay, set_color, shift_gravity
from rlctl.task.events.event import Widening

_WIDER = 2.0  # factor by which the search range is wider than the event's range
_SMALLEST = 0.01  # of the upper end, where a range begins at 0


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A value of an event, searched between `low` and `high`; on a logarithmic scale if both are above 0."""

    event: str
    key: str
    low: float
    high: float
    nominal: float | None = None  # value in the world as the task builds it, if known

    @property
    def name(self) -> str:
        """The name in reports: EVENT.KEY."""
        return f"{self.event}.{self.key}"

    @property
    def is_logarithmic(self) -> bool:
        """Whether the search scale is logarithmic."""
        return self.low > 0

    def value(self, position: float) -> float:
        """Return the value at a position in [0, 1] of the range."""
        if self.is_logarithmic:
            return self.low * math.exp(position * math.log(self.high / self.low))
        return self.low + position * (self.high - self.low)

    @property
    def first(self) -> float:
        """The position to try first: that of the nominal value, or the middle."""
        if self.nominal is None or not self.low <= self.nominal <= self.high:
            return 0.5
        if self.is_logarithmic:
            return math.log(self.nominal / self.low) / math.log(self.high / self.low)
        return (self.nominal - self.low) / (self.high - self.low)

    @property
    def relative_span(self) -> float:
        """Width of the range: of the value's logarithm, or in its own unit."""
        return math.log(self.high / self.low) if self.is_logarithmic else self.high - self.low


@dataclasses.dataclass(frozen=True)
class Unknowns:
    """The values to estimate."""

    parameters: tuple[Parameter, ...]
    delay: str = ""  # the event that delays actions; empty if there is none, or it was not chosen
    longest_delay: int = 0  # [control steps]

    def settings(self, positions: Collection[float]) -> dict[str, dict[str, float]]:
        """Return positions in the ranges as a recipe's `events`."""
        settings: dict[str, dict[str, float]] = {}
        for parameter, position in zip(self.parameters, positions, strict=True):
            settings.setdefault(parameter.event, {})[parameter.key] = parameter.value(position)
        return settings


def find_unknowns(events: Mapping[str, Event], chosen: Collection[str], task: str) -> Unknowns:
    """Return what to estimate of all events, or the chosen ones; raises `UsageError` if that is nothing."""
    for name in chosen:
        check_name(name, events, f"--event: {task} has no event", UsageError)
    parameters: list[Parameter] = []
    delayed, longest = "", 0
    for name, event in events.items():
        ranges = _list_ranges(name, event)
        is_delay = event.when == "action" and event.function is delay
        possible = is_delay or (event.when == "reset" and event.function not in (set_color, shift_gravity) and ranges)
        if name in chosen and not possible:
            raise UsageError(
                f"--event: {name} has no physical value that holds for an episode; identify estimates events at "
                "'reset' and the delay of actions"
            )
        if not possible or (chosen and name not in chosen):
            continue
        if is_delay:
            delayed, longest = name, max(5, 2 * int(ranges["steps"][1]))
        else:
            parameters += [_make_parameter(name, key, *values, event.nominal(key)) for key, values in ranges.items()]
    if not parameters and not delayed:
        raise UsageError(f"{task} has no event with a physical value to estimate: see rlctl tasks show {task}")
    return Unknowns(tuple(parameters), delayed, longest)


def _list_ranges(name: str, event: Event) -> dict[str, tuple[float, float]]:
    values = event.bind(name).values
    return {key: value.end for key, value in values.items() if isinstance(value, Widening)}


def _make_parameter(event: str, key: str, low: float, high: float, nominal: float | None) -> Parameter:
    if low < 0:
        middle, half = (low + high) / 2, _WIDER * max((high - low) / 2, 1e-6)
        return Parameter(event, key, middle - half, middle + half, nominal)
    if low == 0 and nominal is None:  # such as damping, which is most likely 0
        nominal = _SMALLEST * max(high, 1e-6)
    low = low / _WIDER if low > 0 else _SMALLEST * max(high, 1e-6)
    return Parameter(event, key, low, _WIDER * max(high, low), nominal)
