"""Events of a safety filter, stored as arrays until somebody reads them: this keeps each step fast."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.deploy.filter.bounds import Bounds

Array = NDArray[np.float64]
Kind = Literal["limit", "fault", "state"]


@dataclasses.dataclass(frozen=True)
class SafetyEvent:
    """An event of the filter: a limited action, a fault, or a change of state."""

    time_s: float
    kind: Kind
    name: str  # the limit (`elbow.speed`), the kind of fault, or the new state
    value: float | str = ""
    limit: float | None = None

    @property
    def names(self) -> Sequence[str]:
        """The event's name alone; an `Intervention` has several."""
        return (self.name,)

    def list_events(self) -> list[SafetyEvent]:
        """Return the event alone; an `Intervention` makes several."""
        return [self]


@dataclasses.dataclass(slots=True)
class Intervention:
    """A limit that acted in a step, on one joint or more."""

    kind: ClassVar[Kind] = "limit"
    time_s: float
    bounds: Bounds
    limit: str
    requested: Array  # motion before and after the limit
    allowed: Array
    ends: tuple[Array, Array]  # lower and upper bound of the motion
    before: Array  # motion of the step before
    reference: Array | None  # where the motion began
    acted: NDArray[np.bool_]  # whether the limit changed the motion, per joint

    @property
    def names(self) -> Sequence[str]:
        """Names of the joints with the limit's: `elbow.speed`."""
        return [f"{self.bounds.names[index]}.{self.limit}" for index in np.flatnonzero(self.acted).tolist()]

    def list_events(self) -> list[SafetyEvent]:
        """Return an event per joint, with values in the units of the limit."""
        with np.errstate(over="ignore"):  # a policy's action may be any number
            values, limits = self._convert()
        acted = self.acted
        return [
            SafetyEvent(self.time_s, "limit", name, value, limit)
            for name, value, limit in zip(self.names, values[acted].tolist(), limits[acted].tolist(), strict=True)
        ]

    def _convert(self) -> tuple[Array, Array]:
        bounds, dt = self.bounds, self.bounds.dt
        x, allowed = self.requested, self.allowed
        end = np.where(x > allowed, self.ends[1], self.ends[0])
        if self.limit in ("speed", "rate"):
            return x / dt, end / dt
        if self.limit == "acceleration":
            return (x - self.before) / dt**2, (end - self.before) / dt**2
        if self.limit == "action" and not bounds.is_value:
            return x / bounds.factor, end / bounds.factor
        assert self.reference is not None  # positions are bounded from there
        value, at = self.reference + x, self.reference + allowed
        if self.limit == "action":
            return (value - bounds.offset) / bounds.factor, (at - bounds.offset) / bounds.factor
        return value, at
