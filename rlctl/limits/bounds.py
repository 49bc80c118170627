"""Computes which next command keeps every limit now and allows the robot to keep it later; events of limits.

Events are stored as arrays until somebody reads them: this keeps each step fast.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["limit", "fault", "state"]
OnLimit = Callable[[str, Array, Array, tuple[Array, Array]], None]
"""Called if a limit changes a command: its name, the requested and the allowed values, the lower and upper bounds."""


@dataclasses.dataclass(eq=False)
class Bounds:
    """The limits of a policy's actions as arrays, an element per joint.

    A command is a value (positions, torques, plain actions) or a change of a measured position (steps, speeds). Both
    move by `x` in a control step; the arrays bound `x`, its change, and the position after it.
    """

    names: list[str]  # of the joints
    dt: float  # control step [s]
    is_value: bool
    factor: Array  # change of `x` per 1 of the action
    offset: Array  # the value of action 0
    low: Array  # bounds of the command: of a value, or of `x`
    high: Array
    position: Array
    """Bounds of the position after `x`, shape (2, count); infinite where unlimited, as in `speed` and `change`."""
    speed: Array | None  # largest `x`
    change: Array | None  # largest change of `x` from one control step to the next
    precision: float  # relative precision of the action's type
    resolution: Array  # difference between two neighbouring commands near action 1
    position_name: str  # name of the position bounds in events
    speed_name: str
    leads_back: bool = False  # whether a command outside its bounds may stay there, and only move back

    def __post_init__(self) -> None:
        self.bounds_position = bool(np.isfinite(self.position).any())
        self._ends = np.array([self.position[1], -self.position[0]])
        unlimited = np.full(len(self.names), np.inf)
        speed = unlimited if self.speed is None else self.speed
        self._slowest = -speed
        self._most = speed if self.is_value else np.minimum(speed, self.high)
        self._least = self._slowest if self.is_value else np.maximum(-speed, self.low)
        change = unlimited if self.change is None else self.change
        limited = np.isfinite(change)
        s = np.where(limited, change, 1.0)
        # To brake from x takes at most x (x / (2 s) + 1 / 2) + s / 8: the sum in `_find_room` is below it.
        self._per_square, self._per_step = np.where(limited, 0.5 / s, 0.0), np.where(limited, 0.5, 1.0)
        margin = np.where(limited, s / 8.0, 0.0)
        self._quick_low, self._quick_high = -self._ends[1] + margin, self._ends[0] - margin
        # From positions between these even the fastest motion clearly leaves room.
        fastest = np.maximum(np.abs(self._least), np.abs(self._most))
        with np.errstate(invalid="ignore", over="ignore"):
            farthest = fastest * (fastest * self._per_square + self._per_step)
            low, high = self._quick_low + farthest, self._quick_high - farthest
        self._middle_low, self._middle_high = np.where(
            low <= high, (low, high), [[np.inf], [-np.inf]]
        )  # none is between
        self._all = b"\x01" * len(self.names)
        # The last check allows rounding. This is the part of it that is the same for all commands.
        self._slack = self.precision * np.abs(self.offset) + self.resolution
        self._slack_speed = speed + self._slack
        self._slack_change = None if self.change is None else self.change + self._slack
        self._slack_position = self.position[0] - self._slack, self.position[1] + self._slack
        self._slack_low = self.low - self.precision * np.abs(self.low) - self._slack
        self._slack_high = self.high + self.precision * np.abs(self.high) + self._slack

    def bound(self, x: Array, before: Array, reference: Array | None, on_limit: OnLimit) -> Array:
        """Return the motion closest to `x` that keeps the limits.

        `before` is the motion of the last step, `reference` the position after it; None if positions are not bounded.
        """
        reach = None if self.change is None else (before - self.change, before + self.change)
        if self._keeps_all(x, reach, reference):
            return x
        # In order of importance: the last limit wins.
        if reach is not None:
            x = _clip(x, *reach, "acceleration", on_limit)
        if self.speed is not None:
            x = _clip(x, self._slowest, self.speed, self.speed_name, on_limit)
        if not self.is_value:
            x = _clip(x, self.low, self.high, "action", on_limit)
        if self.bounds_position and reference is not None and not self._keeps_position(x, reference):
            room = self._find_room(reference)
            x = _clip(x, -room[1], room[0], self.position_name, on_limit)
        return x

    def list_constants(self) -> dict[str, Array | None]:
        """Return the arrays that the methods compute with, by the names that they have in exported C."""
        return {
            "command_factor": self.factor,
            "command_offset": self.offset,
            "command_low": self.low,
            "command_high": self.high,
            "position_low": self.position[0],
            "position_high": self.position[1],
            "speed": self.speed,
            "change": self.change,
            "least": self._least,
            "most": self._most,
            "per_square": self._per_square,
            "per_step": self._per_step,
            "quick_low": self._quick_low,
            "quick_high": self._quick_high,
            "middle_low": self._middle_low,
            "middle_high": self._middle_high,
            "slack": self._slack,
            "slack_speed": self._slack_speed,
            "slack_change": self._slack_change,
            "slack_position_low": self._slack_position[0],
            "slack_position_high": self._slack_position[1],
            "slack_low": self._slack_low,
            "slack_high": self._slack_high,
        }

    def clip_value(self, value: Array, reference: Array) -> Array:
        """Return a value within the bounds of the command, or between them and the last one, `reference`."""
        low, high = self.low, self.high
        if self.leads_back:
            low, high = np.minimum(low, reference), np.maximum(high, reference)
        return np.asarray(np.minimum(np.maximum(value, low), high))

    def keeps_ends(self, value: Array) -> bool:
        """Return whether a value is within its bounds."""
        return _are_equal(np.minimum(np.maximum(value, self.low), self.high), value)

    def clip_ends(self, value: Array, on_limit: OnLimit) -> Array:
        """Return the value or motion within the bounds of the command."""
        return _clip(value, self.low, self.high, self.position_name if self.is_value else "action", on_limit)

    def keeps_limits(self, command: Array, before: Array, reference: Array | None) -> bool:
        """Return whether a command keeps every limit, to the precision of an action. NaN keeps none.

        This is the last check, of the action that was computed: it uses none of the results of `bound`.
        """
        low, high = self._slack_low, self._slack_high
        if self.leads_back and reference is not None:
            low, high = np.minimum(low, reference - self._slack), np.maximum(high, reference + self._slack)
        if not self._is_between(command, low, high):
            return False
        if reference is None and self.is_value:
            return True  # the position is unknown
        bounds_position = self.bounds_position and not self.is_value and reference is not None
        if self.speed is None and self.change is None and not bounds_position:
            return True
        x = command - reference if self.is_value and reference is not None else command
        least, most = -self._slack_speed, self._slack_speed
        if self._slack_change is not None:
            slowest, fastest = before - self._slack_change, before + self._slack_change
            if not self.is_value:  # a robot pushed past its bounds may brake faster
                slowest, fastest = np.minimum(slowest, -self._slack), np.maximum(fastest, self._slack)
            least, most = np.maximum(least, slowest), np.minimum(most, fastest)
        if bounds_position:
            low, high = self._slack_position
            least = np.maximum(least, np.minimum(low - reference, -self._slack))
            most = np.minimum(most, np.maximum(high - reference, self._slack))
        if self._is_between(x, least, most):
            return True
        slack = self.precision * np.abs(command)
        if reference is not None:
            slack += self.precision * np.abs(reference)
        return self._is_between(x, least - slack, most + slack)

    def _is_between(self, x: Array, low: Array, high: Array) -> bool:
        return bool(((low <= x) & (x <= high)).tobytes() == self._all)

    def _keeps_all(self, x: Array, reach: tuple[Array, Array] | None, reference: Array | None) -> bool:
        """Return whether a motion clearly keeps all limits: a fast check, which most motions pass.

        `reach` has the least and the largest motion that the limit of its change allows.
        """
        low, high = self._least, self._most
        if reach is not None:
            low, high = np.maximum(low, reach[0]), np.minimum(high, reach[1])
        if not _are_equal(np.minimum(np.maximum(x, low), high), x):
            return False
        return not self.bounds_position or reference is None or self._keeps_position(x, reference)

    def _keeps_position(self, x: Array, reference: Array) -> bool:
        """Return whether there is clearly room to brake after a motion that keeps the limit of speed."""
        if _are_equal(np.minimum(np.maximum(reference, self._middle_low), self._middle_high), reference):
            return True
        end = x if self.change is None else x * (np.abs(x) * self._per_square + self._per_step)
        end = end + reference
        return _are_equal(np.minimum(np.maximum(end, self._quick_low), self._quick_high), end)

    def _find_room(self, reference: Array) -> Array:
        """Return how far a step may go up and down, shape (2, count).

        After it there must be room to brake: with motions x, x - s, x - 2 s, ... that a change of at most s allows. Of
        n motions the sum is n x - s n (n - 1) / 2; it must not exceed the distance d to the bound, with the n for which
        (n - 1) s <= x <= n s.
        """
        distance = self._ends.copy()
        distance[0] -= reference
        distance[1] += reference
        np.maximum(distance, 0.0, out=distance)
        if self.change is None:
            return distance
        s = self.change
        n = np.ceil((np.sqrt(1.0 + 8.0 * distance / s) - 1.0) * 0.5)
        np.maximum(n, 1.0, out=n)
        room = distance / n + 0.5 * s * (n - 1.0)
        # No bound on the change, or none on the position.
        return np.where(np.isfinite(room), room, distance)


def _are_equal(a: Array, b: Array) -> bool:
    # Comparing bytes takes a tenth of the time of `(a == b).all()`, but -0.0 and 0.0 are equal.
    return a.tobytes() == b.tobytes() or bool((a == b).all())


def _clip(x: Array, low: Array, high: Array, name: str, on_limit: OnLimit) -> Array:
    allowed: Array = np.minimum(np.maximum(x, low), high)
    if allowed.tobytes() != x.tobytes():
        on_limit(name, x, allowed, (low, high))
    return allowed


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

    def list_events(self) -> list[Self]:
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
