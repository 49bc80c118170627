"""The safety filter: between a policy and a robot, the same in simulation, in a server and from Python."""

import collections
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.deploy.filter.command import Command, UnsafeCommand
from rlctl.deploy.filter.fitting import fit_limits
from rlctl.deploy.filter.limits import Limits, read_limits
from rlctl.deploy.filter.observation import ObservationError, SensorChecks, read_numbers
from rlctl.deploy.filter.safety_events import Intervention, Kind, SafetyEvent
from rlctl.environments.info import EnvInfo
from rlctl.errors import UsageError, short_repr

Array = NDArray[Any]
FilterState = Literal["idle", "running", "holding", "stopped"]

_MAX_EVENTS = 1000  # of the last events


class SafetyFilter:
    """Bounds the actions of a policy, checks its observations, and decides whether it may act.

    In each control step call `observe`, then `limit` with the policy's action, or None where it could not act:

        safety.observe(observation)
        action = safety.limit(policy.predict(observation) if safety.trusts_observation else None)

    States: `idle` before the first action and after `reset`; `running`; `holding` at a fault or by `hold` and `home`;
    `stopped`, which only `resume` leaves. Holding ends when the fault that caused it ends. While holding or
    stopped a robot is braked within its limits and kept where it is, or brought home.

    `info` describes the policy's environment (`policy.info.env`), `limits` is a file or its content; by default
    only the policy's action bounds apply. Raises `RecipeError` for limits that do not fit the policy.
    """

    def __init__(
        self, info: EnvInfo, limits: Limits | Path | str | None = None, *, clock: Callable[[], float] = time.time
    ) -> None:
        if not isinstance(limits, Limits):
            limits = Limits() if limits is None else read_limits(Path(limits))
        fitted = fit_limits(limits, info)
        self.limits, self.layout, self.control_dt = limits, fitted.layout, fitted.control_dt
        self._space, self._measured, self._home = fitted.space, fitted.measured, fitted.home
        self._sensors = SensorChecks(limits, fitted.layout, fitted.control_dt)
        self._command: Command | None = None
        if fitted.bounds is not None:
            self._command = Command(limits, fitted, fitted.bounds, self._record_intervention)
        self._clock = clock
        self._history: collections.deque[SafetyEvent | Intervention] = collections.deque(maxlen=_MAX_EVENTS)
        self._limits_acted: dict[str, NDArray[np.int64]] = {}
        self._faults: collections.Counter[str] = collections.Counter()
        self.on_event: Callable[[SafetyEvent | Intervention], None] | None = None
        """Called with each event, those of one limit in a step together."""
        self.steps = 0  # actions since the filter was created
        self.state: FilterState = "idle"
        self.reason = ""  # why it is holding or stopped
        self._zeros = np.zeros(math.prod(fitted.space.shape or ()))
        self._all_finite = b"\x01" * len(self._zeros)
        self._fault = ""
        self._observed = self._ordered = self._goes_home = False
        self._manual: Array | None = None

    def reset(self) -> None:
        """Begin an episode. A stop, a `hold` or `home`, and an override stay in effect."""
        self._fault, self._observed = "", False
        self._sensors.reset()
        if self._command is not None:
            self._command.reset()
        if self.state != "stopped" and not self._ordered:
            self._enter("idle", "")

    def stop(self, reason: str = "stopped") -> None:
        """Stop; only `resume` leaves this state."""
        self._ordered = False
        self._enter("stopped", reason)

    def hold(self, reason: str = "hold ordered") -> None:
        """Keep the robot where it is until `resume`; a stop stays in effect."""
        if self.state != "stopped":
            self._ordered, self._goes_home = True, False
            self._enter("holding", reason)

    def home(self, reason: str = "home ordered") -> None:
        """Bring the robot home and keep it there until `resume`; ends a stop. Raises `UsageError` without a home."""
        if self._home is None:
            raise UsageError("the limits define no home; write home: [positions] in the limits file")
        self._ordered = self._goes_home = True
        self.begin_blend()
        self._enter("holding", reason)

    def resume(self) -> None:
        """Let the policy act again from the robot's present position; a fault that persists holds it again at once."""
        self._ordered = False
        self._fault = ""
        if self._command is not None and self.state == "stopped":
            self._command.begin_from_measured()
        self.begin_blend()
        self._enter("idle", "")

    def override(self, action: Any | None) -> None:
        """Replace the policy's actions by this one from now on; None ends the override.

        Both begin with a blend. Limits, stops and faults stay in effect. Raises `ValueError` for an invalid action.
        """
        if action is not None:
            action, fault = self._read_action(action)
            if action is None:
                expected = f"{len(self._zeros)} finite numbers" if self._command else f"one of {self._space}"
                raise ValueError(f"override: expected {expected}, got {fault}")
        if (action is None) != (self._manual is None):
            self.begin_blend()
            self._record("state", "policy" if action is None else "override")
        self._manual = action

    @property
    def events(self) -> list[SafetyEvent]:
        """The last 1000 events, oldest first."""
        return self.find_last_events(_MAX_EVENTS)

    def find_last_events(self, count: int) -> list[SafetyEvent]:
        """Return the last events, oldest first."""
        events: list[SafetyEvent] = []
        for record in reversed(self._history):
            if len(events) >= count:
                break
            events += reversed(record.list_events())
        return events[:count][::-1]

    @property
    def counts(self) -> collections.Counter[str]:
        """Number of interventions per limit and joint, and of each fault, since the filter was created."""
        counts = collections.Counter(self._faults)
        if self._command is not None:
            for limit, times in self._limits_acted.items():
                acted = zip(self._command.names, times.tolist(), strict=True)
                counts.update({f"{joint}.{limit}": count for joint, count in acted if count})
        return counts

    @property
    def is_overridden(self) -> bool:
        """Whether an override replaces the policy's actions."""
        return self._manual is not None

    def begin_blend(self) -> None:
        """Blend gradually into the next actions, as after a change of the policy."""
        if self._command is not None:
            self._command.begin_blend()

    @property
    def control_error(self) -> float:
        """Largest difference between a joint's position and the one expected from the last command; NaN if unknown."""
        return math.nan if self._command is None else self._command.find_error()

    @property
    def trusts_observation(self) -> bool:
        """Whether the last observation had no fault, so that the policy may use it."""
        return self._observed and not self._fault

    def observe(self, observation: Any, age_s: float = 0.0) -> bool:
        """Check an observation in the policy's form; None: it is missing. Return whether it may be used.

        `age_s` is its age [s]. A negative age, of an observation from the future, has the same limit.
        """
        if observation is None:
            return self.fail("missing")
        try:
            values, (age,) = self.layout.flatten(observation), read_numbers(age_s)
        except ValueError as error:  # no numbers, or an age that is not one number
            return self.fail("invalid observation", short_repr(str(error), 200))
        fault = self._sensors.check(values, float(age))
        self._observed = True
        if fault is not None:
            kind, name, value, limit = fault
            return self.fail(f"{name} {kind}", value, limit)
        if self._measured is not None and self._command is not None:
            self._command.measure(values[self._measured])
        self._fault = ""
        return True

    def fail(self, what: str, value: float | str = "", limit: float | None = None) -> bool:
        """Record a fault of the observation, which triggers `on_fault` of the limits; return False."""
        self._record("fault", what, value, limit)
        self._fault = what
        return False

    @np.errstate(all="ignore")  # a policy's action may be any number; the last check is of the result
    def limit(self, action: Any | None) -> Array:
        """Return the robot's action for the policy's action; None: the policy could not act."""
        self.steps += 1
        requested, problem = (self._manual, "") if self._manual is not None else self._read_action(action)
        fault = self._fault or self._find_fault(requested, problem)
        if self.state != "stopped" and not self._ordered:
            self._update_state(fault)
        if self._command is None:
            return self._choose(requested if self.state == "running" else None)
        try:
            if self.state == "running" and requested is not None:
                return self._command.follow(requested)
            return self._command.rest(self._goes_home and self.state == "holding")
        except UnsafeCommand as unsafe:
            self._record("limit", unsafe.limit, unsafe.value, unsafe.bound)
            self._enter("stopped", str(unsafe))
            return self._command.stand_still()

    def _read_action(self, action: Any | None) -> tuple[Array | None, str]:
        """Return an action as numbers, or None and why it is invalid."""
        if action is None:
            return None, ""
        try:
            numbers = read_numbers(action)  # a copy: a policy may write the next one into the same memory
        except ObservationError as error:
            return None, str(error)
        if numbers.shape != self._zeros.shape:
            return None, f"shape {numbers.shape}"
        if np.isfinite(numbers).tobytes() != self._all_finite:
            return None, "not finite"
        if self._command is None:
            with np.errstate(invalid="ignore"):
                choice = self._choose(numbers)
            if not self._space.contains(choice) or (choice.ravel() != numbers).any():
                return None, f"{short_repr(numbers.tolist())}"
        return numbers, ""

    def _find_fault(self, requested: Array | None, problem: str) -> str:
        """Return and record why an action cannot be used; empty if it can."""
        fault = ""
        if problem:
            fault = "invalid action"
        elif requested is None:
            fault = "" if self.state == "stopped" or self._ordered else "no action"
        elif self._measured is not None and self._command is not None and self._command.position is None:
            fault = "no position"
        if fault:
            self._record("fault", fault, problem)
        return fault

    def _update_state(self, fault: str) -> None:
        """Enter the state for this step's fault, or for its end."""
        if fault and self.limits.on_fault == "stop":
            self._enter("stopped", fault)
        elif fault:
            self._goes_home = self.limits.on_fault == "home"
            self._enter("holding", fault)
        elif self.state != "running":
            self.begin_blend()
            self._enter("running", "")

    def _choose(self, action: Any | None) -> Array:
        """Return a choice, or the first alternative where the policy may not act."""
        space = self._space
        if action is None:
            return np.full(space.shape or (), getattr(space, "start", 0), space.dtype)
        return np.asarray(action, space.dtype).reshape(space.shape or ())

    def _enter(self, state: FilterState, reason: str) -> None:
        if state != self.state or reason != self.reason:
            self.state, self.reason = state, reason
            self._record("state", state, reason)

    def _record_intervention(self, intervention: Intervention) -> None:
        intervention.time_s = self._clock()
        if (counts := self._limits_acted.get(intervention.limit)) is None:
            counts = self._limits_acted[intervention.limit] = np.zeros(len(intervention.acted), np.int64)
        np.add(counts, intervention.acted, out=counts)
        self._append(intervention)

    def _record(self, kind: Kind, name: str, value: float | str = "", limit: float | None = None) -> None:
        if kind != "state":
            self._faults[name] += 1
        self._append(SafetyEvent(self._clock(), kind, name, value, limit))

    def _append(self, event: SafetyEvent | Intervention) -> None:
        self._history.append(event)
        if self.on_event is not None:
            self.on_event(event)
