"""`Event`: a named change of a task, with its parameters and the ranges from which it draws values."""

from __future__ import annotations

import dataclasses
import inspect
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rlctl.errors import RecipeError, RlctlError, TaskError, check_name

Range = tuple[float, float]
"""A range of random values, as a parameter of an event function: lowest and highest value.

A task or a recipe writes `[low, high]`, one number, or `{"from": [low, high], "to": [low, high]}` for a range that
goes from the first to the second as the environment's level goes from 0 to 1.
"""


@dataclasses.dataclass(frozen=True)
class RangeLimits:
    """Limits of the values of a range, in its annotation: `Annotated[Range, RangeLimits(low=0.0)]`."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False  # whether `low` itself is excluded
    whole: bool = False  # whole numbers only; the upper end of the range is included

    def find_violation(self, value: float) -> str:
        """Return why a value is outside the limits; empty if it is inside."""
        if self.whole and value != int(value):
            return f"{value:g} is not a whole number"
        if value < self.low or (self.above and value == self.low):
            return f"{value:g} is not {'above' if self.above else 'at least'} {self.low:g}"
        return f"{value:g} is not at most {self.high:g}" if value > self.high else ""


Positive = Annotated[Range, RangeLimits(0.0, above=True)]
NotNegative = Annotated[Range, RangeLimits(0.0)]
Fraction = Annotated[Range, RangeLimits(0.0, 1.0)]
Steps = Annotated[Range, RangeLimits(0.0, whole=True)]


class Widening(NamedTuple):
    """A range at level 0 and at level 1."""

    start: Range
    end: Range
    whole: bool = False

    def at(self, level: float) -> Range:
        """Return the range at a level in [0, 1]: each end moves on a straight line."""
        low, high = ((1 - level) * first + level * last for first, last in zip(self.start, self.end, strict=True))
        return (round(low), round(high)) if self.whole else (low, high)


def read_range(where: str, value: Any, limits: RangeLimits, error: type[Exception] = TaskError) -> Widening:
    """Read the range that a task or a recipe gives; raises `error` with a message that begins with `where`."""
    if not isinstance(value, Mapping):
        pair = _pair(where, value, limits, error)
        return Widening(pair, pair, limits.whole)
    if value.keys() != {"from", "to"}:
        raise error(f"{where}: a range has the keys 'from' and 'to', not {', '.join(map(repr, value))}. {_EXPECTED}")
    start = _pair(f"{where}.from", value["from"], limits, error)
    return Widening(start, _pair(f"{where}.to", value["to"], limits, error), limits.whole)


_EXPECTED = "Write [low, high], a number, or {from: [low, high], to: [low, high]}."


def _pair(where: str, value: Any, limits: RangeLimits, error: type[Exception]) -> Range:
    numbers = list(value) if isinstance(value, list | tuple | np.ndarray) else [value, value]
    if len(numbers) != 2 or not all(_is_number(number) for number in numbers):
        raise error(f"{where}: {value!r} is not a range of finite numbers. {_EXPECTED}")
    low, high = (float(number) for number in numbers)
    if low > high:
        raise error(f"{where}: [{low:g}, {high:g}] is reversed. Write the lower value first: [{high:g}, {low:g}].")
    for number in (low, high):
        if violation := limits.find_violation(number):
            raise error(f"{where}: {violation}.")
    return low, high


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)


When = Literal["reset", "start", "interval", "observation", "action"]
Drawn = dict[str, float]
ObservationParts = dict[str, NDArray[Any]]
Signal = Callable[[ObservationParts], ObservationParts]
"""Changes the values of a control step, by name: a sensor or a motor with noise or delay."""

Change = Callable[..., Drawn]
"""`(sim, rng, **parameters)`: changes the world relative to its nominal values; returns the drawn values."""
SignalMaker = Callable[..., tuple[Drawn, Signal]]
"""`(rng, first, **parameters)`: starts an episode with the values `first`; returns the drawn values and a signal."""

_MOMENTS: tuple[When, ...] = typing.get_args(When)
_SETTINGS: Mapping[When, list[str]] = {"interval": ["every_s"], "observation": ["of"]}
_acts_at: dict[Callable[..., Any], tuple[When, ...]] = {}
_nominal: dict[Callable[..., Any], Mapping[str, float]] = {}

_Function = TypeVar("_Function", bound=Callable[..., Any])


def acts_at(*when: When, **nominal: float) -> Callable[[_Function], _Function]:
    """Mark an event function with its possible moments; an unmarked function may act at any.

    `nominal` has, for some parameters, the value with which the function changes nothing.
    """

    def mark(function: _Function) -> _Function:
        _acts_at[function] = when
        _nominal[function] = nominal
        return function

    return mark


class Event:
    """A change `function(..., **parameters)` that a task offers and a recipe enables, or that is always enabled.

    `when` is one of
    - `reset`: before the task's own reset, for properties such as a mass;
    - `start`: after the task's reset, for a state such as joint angles or velocities;
    - `interval`: every `every_s` seconds of an episode;
    - `observation`: on the observations, or only on the names in `of`, at every step;
    - `action`: on the action that `Task.act` gets, at every step.

    A recipe enables events; an event that is part of the task has `enabled=True`.
    """

    def __init__(
        self,
        when: When,
        function: Change | SignalMaker,
        *,
        every_s: float = 1.0,
        of: str | Sequence[str] = (),
        enabled: bool = False,
        **parameters: Any,
    ) -> None:
        self.when = when
        self.function = function
        self.every_s = every_s
        self.of = of
        self.enabled = enabled
        self.parameters = parameters

    @property
    def parameter_names(self) -> list[str]:
        """Parameters that a recipe can set: those of the function, then `every_s` or `of` for events that have them."""
        return [*self._signature, *_SETTINGS.get(self.when, [])]

    @cached_property
    def _signature(self) -> dict[str, inspect.Parameter]:
        found = list(inspect.signature(self.function).parameters.values())[2:]
        return {p.name: p for p in found if p.kind is not p.VAR_KEYWORD}

    @property
    def ranges(self) -> dict[str, RangeLimits]:
        """The parameters that are ranges, with the limits of their values; those that the task sets come first."""
        names = sorted(self._signature, key=lambda name: name not in self.parameters)
        found = {name: _find_limits(self._hints.get(name)) for name in names}
        return {name: limits for name, limits in found.items() if limits is not None}

    def nominal(self, parameter: str) -> float | None:
        """Return the value of a parameter with which the event changes nothing; None if there is no such value."""
        return _nominal.get(self.function, {}).get(parameter)

    def with_parameters(self, name: str, changes: Mapping[str, Any]) -> Event:
        """Return this event, enabled, with some parameters replaced; errors mention `name`."""
        for key in changes:
            check_name(key, self.parameter_names, f"events.{name}: no parameter", RecipeError)
        settings = {"every_s": self.every_s, "of": self.of, **self.parameters, **changes}
        return Event(self.when, self.function, enabled=True, **settings)

    def bind(self, name: str, error: type[RlctlError] = TaskError) -> BoundEvent:
        """Check everything that needs no world; raises `error` with a message that begins with `events.<name>`."""
        where, function = f"events.{name}", getattr(self.function, "__name__", str(self.function))
        check_name(self.when, _MOMENTS, f"{where}: no moment", error, listed="There are")
        possible = _acts_at.get(self.function, _MOMENTS)
        if self.when not in possible:
            raise error(f"{where}: {function} does not act at {self.when!r}, but at: {', '.join(possible)}.")
        if not any(p.kind is p.VAR_KEYWORD for p in inspect.signature(self.function).parameters.values()):
            for key in self.parameters:
                check_name(key, self.parameter_names, f"{where}: no parameter", error)
        for key, parameter in self._signature.items():
            if parameter.annotation is parameter.empty:
                raise TaskError(
                    f"{where}: {key!r} of {function} has no type, so it cannot be checked. Write `{key}: Range` for "
                    "a range of random values, else its type."
                )
            if parameter.default is parameter.empty and key not in self.parameters:
                raise error(f"{where}: parameter {key!r} is missing. It has: {', '.join(self.parameter_names)}.")
        values = {key: self._read(f"{where}.{key}", key, value, error) for key, value in self.parameters.items()}
        if self.when == "observation":
            _check_type(f"{where}.of", str | Sequence[str], self.of, error)
        elif self.of:
            raise error(f"{where}.of: only events at 'observation' have it, not {self.when!r}.")
        if self.when == "interval":
            read_range(f"{where}.every_s", self.every_s, RangeLimits(0.0, above=True), error)
        return BoundEvent(name, self, values, error)

    @cached_property
    def _hints(self) -> dict[str, Any]:
        try:
            return typing.get_type_hints(self.function, include_extras=True)
        except NameError as error:
            name = getattr(self.function, "__name__", str(self.function))
            raise TaskError(f"event function {name}: {error}; import it outside of `if TYPE_CHECKING:`") from None

    def _read(self, where: str, key: str, value: Any, error: type[RlctlError]) -> Any:
        hint = self._hints.get(key)
        if (limits := _find_limits(hint)) is not None:
            return read_range(where, value, limits, error)
        if hint is not None:  # else the function takes any keywords
            _check_type(where, hint, value, error)
        return value


def _find_limits(hint: Any) -> RangeLimits | None:
    """Return the limits of a range of this type; None for a type that is not a range."""
    if hint != Range and getattr(hint, "__origin__", None) != Range:
        return None
    return next((m for m in getattr(hint, "__metadata__", ()) if isinstance(m, RangeLimits)), RangeLimits())


def _check_type(where: str, hint: Any, value: Any, error: type[RlctlError]) -> None:
    import pydantic

    try:
        adapter = pydantic.TypeAdapter(hint)
        adapter.validate_python(value)
    except pydantic.ValidationError as problem:
        from rlctl.storage import validation

        raise error(validation.explain_invalid(problem, adapter, value, where)) from None
    except pydantic.errors.PydanticSchemaGenerationError:
        return  # a type of the author's own


@dataclasses.dataclass(frozen=True)
class BoundEvent:
    """A checked event that acts in an environment; its mistakes raise `error`."""

    name: str
    event: Event
    values: Mapping[str, Any]
    error: type[RlctlError]

    def __call__(self, first: Any, second: Any, level: float) -> Any:
        """Call the function, with its ranges at `level`."""
        return self.event.function(first, second, **{key: self.read(key, level) for key in self.values})

    def read(self, key: str, level: float) -> Any:
        """Return a parameter; a range is that at `level`."""
        value = self.values[key]
        return value.at(level) if isinstance(value, Widening) else value


@dataclasses.dataclass(frozen=True)
class EventSettings:
    """The events of a task that a recipe enables and changes."""

    randomize: bool = False
    changes: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)

    def apply(self, events: Mapping[str, Event]) -> dict[str, BoundEvent]:
        """Return the enabled events, by name; the others are checked too."""
        for name in self.changes:
            check_name(name, events, "events: this task has no event", RecipeError)
        active = {}
        for name, event in events.items():
            bound = event.bind(name)
            if name in self.changes:
                active[name] = event.with_parameters(name, self.changes[name]).bind(name, RecipeError)
            elif event.enabled or self.randomize:
                active[name] = bound
        return active


def describe_randomization(events: Mapping[str, bool]) -> str:
    """Return `randomised by NAMES` or `not randomised`; empty for an environment without events."""
    if acting := [name for name, acts in events.items() if acts]:
        return f"randomised by {', '.join(acting)}"
    return "not randomised" if events else ""
