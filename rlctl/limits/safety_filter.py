"""The safety filter: between a policy and a robot, the same in simulation, in a server and from Python."""

import collections
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rlctl.environments.info import EnvInfo
from rlctl.errors import UsageError, short_repr
from rlctl.limits.bounds import Intervention, Kind, SafetyEvent
from rlctl.limits.command import Command, UnsafeCommand
from rlctl.limits.fitting import fit_limits
from rlctl.limits.limits import NO_LIMITS, Limits, read_limits
from rlctl.limits.observation import ObservationError, read_numbers

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

    `info` is `policy.info.env`; `limits` a file, its content, or None for the policy's action bounds alone. Raises
    `RecipeError` for limits that do not fit the policy.
    """

    def __init__(
        self, info: EnvInfo, limits: Limits | Path | str | None = None, *, clock: Callable[[], float] = time.time
    ) -> None:
        if not isinstance(limits, Limits):
            limits = NO_LIMITS if limits is None else read_limits(Path(limits))
        fitted = fit_limits(limits, info)
        self.limits, self.reader, self.control_dt = fitted.limits, fitted.reader, fitted.control_dt
        self._space, self._measured, self._home = fitted.space, fitted.measured, fitted.home
        self._sensors = fitted.sensors
        bounds = fitted.bounds
        self._joints = [] if bounds is None else bounds.names
        self.command = None if bounds is None else Command(self.limits, fitted, bounds, self._record_intervention)
        self._clock = clock
        self._history: collections.deque[SafetyEvent | Intervention] = collections.deque(maxlen=_MAX_EVENTS)
        count = math.prod(fitted.space.shape or ())
        self._limits_acted = collections.defaultdict[str, NDArray[np.int64]](lambda: np.zeros(count, np.int64))
        self._faults: collections.Counter[str] = collections.Counter()
        self.on_event: Callable[[SafetyEvent | Intervention], None] | None = None
        """Called with each event, those of one limit in a step together."""
        self.steps = 0  # actions since the filter was created
        self.state: FilterState = "idle"
        self.reason = ""  # why it is holding or stopped
        self._all_finite = b"\x01" * count
        self._fault = ""
        self._observed = self._ordered = self._goes_home = False
        self.manual: Array | None = None
        """The action of an override; None: the policy acts."""

    def reset(self) -> None:
        """Begin an episode. A stop, a `hold` or `home`, and an override stay in effect."""
        self._fault, self._observed = "", False
        self._sensors.reset()
        if self.command is not None:
            self.command.reset()
        if self.state != "stopped" and not self._ordered:
            self._enter("idle", "")

    def stop(self, reason: str = "stop ordered") -> None:
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
        self._ordered, self._fault = False, ""
        if self.command is not None and self.state == "stopped":
            self.command.begin_from_measured()
        self.begin_blend()
        self._enter("idle", "")

    def override(self, action: Any | None) -> None:
        """Replace the policy's actions by this one from now on; None ends the override.

        Both begin with a blend. Limits, stops and faults stay in effect. Raises `ValueError` for an invalid action.
        """
        if action is not None:
            action, fault = self._read_action(action)
            if action is None:
                raise ValueError(f"override: expected an action of {self._space}, got {fault}")
        if (action is None) != (self.manual is None):
            self.begin_blend()
            self._record("state", "policy" if action is None else "override")
        self.manual = action

    @property
    def events(self) -> list[SafetyEvent]:
        """The last 1000 events, oldest first."""
        return self.find_last_events(_MAX_EVENTS)

    def find_last_events(self, count: int) -> list[SafetyEvent]:
        """Return the last events, oldest first."""
        return [event for record in list(self._history)[-count:] for event in record.list_events()][-count:]

    @property
    def counts(self) -> collections.Counter[str]:
        """Number of interventions per limit and joint, and of each fault, since the filter was created."""
        counts = collections.Counter(self._faults)
        for limit, times in self._limits_acted.items():
            counts.update({f"{self._joints[index]}.{limit}": int(times[index]) for index in np.flatnonzero(times)})
        return counts

    def begin_blend(self) -> None:
        """Blend gradually into the next actions, as after a change of the policy."""
        if self.command is not None:
            self.command.begin_blend()

    @property
    def control_error(self) -> float:
        """Largest difference between a joint's position and the one expected from the last command; NaN if unknown."""
        return math.nan if self.command is None else self.command.find_error()

    @property
    def trusts_observation(self) -> bool:
        """Whether the last observation had no fault, so that the policy may use it."""
        return self._observed and not self._fault

    def observe(self, observation: Any, age_s: float = 0.0) -> bool:
        """Check an observation in the policy's form; None: it is missing. Return whether it may be used.

        The limit of its age `age_s` [s] also applies to a negative age, of an observation from the future.
        """
        if observation is None:
            return self.fail("missing")
        try:
            values = self.reader.flatten(observation)
            (age,) = (age_s,) if type(age_s) is float else read_numbers(age_s)  # most calls need no array
        except ValueError as error:  # no numbers, or an age that is not one number
            return self.fail("invalid observation", short_repr(str(error), 200))
        self._observed = True
        if (fault := self._sensors.check(values, float(age))) is not None:
            return self.fail(*fault)
        if self._measured is not None and self.command is not None:
            self.command.measure(self._measured.read(values))
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
        requested, problem = (self.manual, "") if self.manual is not None else self._read_action(action)
        fault = self._fault or self._find_fault(requested, problem)
        if self.state != "stopped" and not self._ordered:
            self._update_state(fault)
        if self.command is None:
            return self._choose(requested if self.state == "running" else None)
        try:
            if self.state == "running" and requested is not None:
                return self.command.follow(requested)
            return self.command.rest(self._goes_home and self.state == "holding")
        except UnsafeCommand as unsafe:
            self._record("limit", unsafe.limit, unsafe.value, unsafe.bound)
            self._enter("stopped", str(unsafe))
            return self.command.stand_still()

    def _read_action(self, action: Any | None) -> tuple[Array | None, str]:
        """Return an action as numbers, or None and why it is invalid."""
        if action is None:
            return None, ""
        try:
            numbers = read_numbers(action)  # a copy: a policy may write the next one into the same memory
        except ObservationError as error:
            return None, str(error)
        is_valid = np.isfinite(numbers).tobytes() == self._all_finite
        if is_valid and self.command is None:
            with np.errstate(invalid="ignore"):
                choice = self._choose(numbers)
            is_valid = self._space.contains(choice) and bool((choice.ravel() == numbers).all())
        return (numbers, "") if is_valid else (None, short_repr(numbers.tolist()))

    def _find_fault(self, requested: Array | None, problem: str) -> str:
        if problem:
            fault = "invalid action"
        elif requested is None and self.state != "stopped" and not self._ordered:
            fault = "no action"
        elif requested is not None and self._measured is not None and self.command and self.command.position is None:
            fault = "no position"
        else:
            return ""
        self._record("fault", fault, problem)
        return fault

    def _update_state(self, fault: str) -> None:
        if fault:
            self._goes_home = self.limits.on_fault == "home"
            self._enter("stopped" if self.limits.on_fault == "stop" else "holding", fault)
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
        self._limits_acted[intervention.limit] += intervention.acted
        self._append(intervention)

    def _record(self, kind: Kind, name: str, value: float | str = "", limit: float | None = None) -> None:
        if kind != "state":
            self._faults[name] += 1
        self._append(SafetyEvent(self._clock(), kind, name, value, limit))

    def _append(self, event: SafetyEvent | Intervention) -> None:
        self._history.append(event)
        if self.on_event is not None:
            self.on_event(event)
